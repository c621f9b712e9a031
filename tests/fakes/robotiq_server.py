"""A Robotiq gripper behind a real socket, with the protocol of its URCap and the ways in which it can go wrong."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol


class Mechanism(Protocol):
    """The fingers; positions are counts of POS."""

    def go(self, position: int) -> None: ...

    def stop(self) -> None: ...

    def tick(self) -> None: ...

    @property
    def position(self) -> int: ...

    @property
    def seen(self) -> int: ...


class Fingers:
    """Fingers without physics: 40 counts a tick, stopped at `thing` while closing."""

    def __init__(self, thing: int | None = None, *, position: int = 3, limits: tuple[int, int] = (3, 228)) -> None:
        self.thing, self.at, self.target, self.limits = thing, position, position, limits
        self.moving = False

    def go(self, position: int) -> None:
        self.target, self.moving = position, True

    def stop(self) -> None:
        self.moving = False

    def tick(self) -> None:
        if not self.moving:
            if self.thing is None and self.seen == 2:
                self.at = self.limits[1]
            return
        step = max(-40, min(40, self.target - self.at))
        after = min(max(self.at + step, self.limits[0]), self.limits[1])
        if self.thing is not None and step > 0:
            after = min(after, self.thing)
        self.moving = after != self.at and after != self.target
        self.at = after

    @property
    def position(self) -> int:
        return self.at

    @property
    def seen(self) -> int:
        if self.moving:
            return 0
        if self.thing is not None and self.at == self.thing and self.target > self.at:
            return 2
        return 3


class FakeGripperServer:
    """Serves one gripper on 127.0.0.1.

    Attributes:
        registers: What GET says of the rest.
        requests: Everything that was asked.
        spoil: Changes a reply before it is sent; b"" = silence, None = the connection is closed.
        ending: What a line ends with.
        pieces: Replies are sent in so many pieces.
        delay_s: Before each reply.
        late: So many looks at OBJ after a request still say what was before it.
        ack_ending: What an "ack" ends with; None = as every line.
    """

    def __init__(self, fingers: Mechanism | None = None, *, active: bool = True) -> None:
        self.fingers: Mechanism = fingers or Fingers()
        on = int(active)
        self.registers = {"ACT": on, "GTO": 0, "STA": 3 * on, "FLT": 0, "PRE": 3, "SPE": 0, "FOR": 0, "ATR": 0}
        self.requests: list[str] = []
        self.ack_ending: bytes | None = None
        self.spoil: Callable[[str, bytes], bytes | None] = lambda request, reply: reply
        self.ending, self.pieces, self.delay_s = b"\n", 1, 0.0
        self.late, self._before, self._activating = 0, (0, 3), 0
        self.lock = threading.RLock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._closed = False
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._closed = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # a thread that waits in accept keeps it open otherwise
        self._listener.close()
        for connection in self._connections:
            connection.close()

    def _serve(self) -> None:
        while not self._closed:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(connection)
            threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        buffer = b""
        with connection:
            while not self._closed:
                try:
                    part = connection.recv(1024)
                    if not part:
                        return
                    buffer += part
                    while b"\n" in buffer:
                        line, _, buffer = buffer.partition(b"\n")
                        if not self._answer(connection, line.decode()):
                            return
                except OSError:
                    return

    def _answer(self, connection: socket.socket, request: str) -> bool:
        with self.lock:
            self.requests.append(request)
            reply = self.spoil(request, self._reply(request))
        if reply is None:
            return False
        if self.delay_s:
            time.sleep(self.delay_s)
        ending = self.ack_ending if reply == b"ack" and self.ack_ending is not None else self.ending
        whole = reply + ending if reply else b""
        size = max(1, -(-len(whole) // self.pieces))
        for start in range(0, len(whole), size):
            connection.sendall(whole[start : start + size])
            if self.pieces > 1:
                time.sleep(0.002)
        return True

    def _reply(self, request: str) -> bytes:
        words = request.split()
        if words[0] == "GET":
            self.fingers.tick()
            name = words[1]
            if name == "OBJ" and self._before[0] > 0:
                self._before = (self._before[0] - 1, self._before[1])
                return f"OBJ {self._before[1]}".encode()
            if name == "STA" and self._activating > 0:
                self._activating -= 1
                self.registers["STA"] = 1 if self._activating else 3
            value = {"POS": self.fingers.position, "OBJ": self.fingers.seen}.get(name, self.registers.get(name, 0))
            return f"{name} {value}".encode()
        values = dict(zip(words[1::2], map(int, words[2::2]), strict=True))
        for name in sorted(values, key=lambda n: n == "POS"):  # one write of all registers: GTO counts with POS
            self._set(name, values[name])
        return b"ack"

    def _set(self, name: str, value: int) -> None:
        self.registers[name] = value
        if name == "ACT":
            self.registers["STA"], self._activating = 0, 3 * value
        if name == "GTO" and not value:
            self.fingers.stop()
        if name == "POS":
            self.registers["PRE"] = value
        if self.registers["GTO"] and self.registers["STA"] == 3 and name == "POS":
            self._before = (self.late, self.fingers.seen)
            self.fingers.go(value)


@contextmanager
def gripper_server(fingers: Mechanism | None = None, *, active: bool = True) -> Iterator[FakeGripperServer]:
    server = FakeGripperServer(fingers, active=active)
    try:
        yield server
    finally:
        server.close()
