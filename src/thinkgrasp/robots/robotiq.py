"""Robotiq 2F-85 and 2F-140 through the socket that their URCap opens on the robot's controller.

Lines of ASCII: `GET VAR` is answered with `VAR value`, `SET VAR value [VAR value ...]` with `ack`; replies may come
without a line end. ACT activates, GTO lets it move, POS, SPE and FOR are 0..255; STA says whether it is activated, OBJ
whether it moves or met something, FLT what is wrong.

References:
    Robotiq, "2F-85 & 2F-140 instruction manual for e-Series": registers, ranges of speed, force and stroke, faults.
"""

from __future__ import annotations

import contextlib
import re
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from thinkgrasp.errors import ConfigError

PORT = 63352
OPEN_COUNT, CLOSED_COUNT = 3, 228
"""What POS says of a 2F-85 that is fully open, and with its pads together."""
_REPLY = re.compile(rb"\s*([A-Z]{3})[ \t]+(\S+)")
_ACK = re.compile(rb"\s*ack")
_QUIET_S = 0.03
"""After this long without another byte a reply without line end is complete, if it makes sense; where one of its
kind once ended a line, the line's end is waited for."""
_LONGEST_REPLY = 256
_ACTIVE = 3
STILL_HELD_M = 0.006
"""What is held may give way by this much."""
_NEAR_M, _LATE_S = 0.008, 0.5
"""A gripper that says it is where it was told to be is there to within this, or soon is: OBJ may be late."""

FAULTS = {
    0x05: "an action waits for activation",
    0x07: "the activation bit must be set before the action",
    0x08: "the gripper is too hot",
    0x09: "no communication with the gripper for a second",
    0x0A: "the supply voltage is too low",
    0x0B: "an automatic release is in progress",
    0x0C: "internal fault",
    0x0D: "the activation failed: something is in the way of the fingers",
    0x0E: "overcurrent",
    0x0F: "an automatic release was completed",
}
_HARMLESS = frozenset({0x00, 0x05, 0x07})
"""Faults that an activation clears."""


@dataclass(frozen=True)
class GripperModel:
    """What the maker says of one model."""

    stroke_m: float
    force_n: tuple[float, float]
    """At FOR 0 and 255."""
    speed_m_s: tuple[float, float]
    """At SPE 0 and 255."""


MODELS = {
    "robotiq_2f85": GripperModel(0.085, (20.0, 235.0), (0.020, 0.150)),
    "robotiq_2f140": GripperModel(0.140, (10.0, 125.0), (0.030, 0.250)),
}


class Seen(IntEnum):
    """The register OBJ."""

    MOVING = 0
    STOPPED_OPENING = 1
    STOPPED_CLOSING = 2
    AT_POSITION = 3


class GripperError(Exception):
    """The gripper cannot be worked with; `reason` is the named reason of the attempt."""

    reason: Literal["gripper_silent", "gripper_fault"] = "gripper_fault"


class GripperSilent(GripperError):
    """No reply in time, none that makes sense, or the connection is gone."""

    reason = "gripper_silent"


@dataclass(frozen=True)
class Counts:
    """Maps openings, forces and speeds to the registers' 0..255 and back; openings are taken as linear in POS.

    Raises:
        ConfigError: No such model, or the counts are not ordered.
    """

    model: str = "robotiq_2f85"
    open_count: int = OPEN_COUNT
    closed_count: int = CLOSED_COUNT

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ConfigError(f"no gripper model {self.model!r} with a socket; allowed are {', '.join(MODELS)}")
        if not 0 <= self.open_count < self.closed_count <= 255:
            raise ConfigError(
                f"gripper: need 0 <= open_count < closed_count <= 255, got {self.open_count} and {self.closed_count}"
            )

    @property
    def maker(self) -> GripperModel:
        """What the maker says of this model."""
        return MODELS[self.model]

    def position(self, opening_m: float) -> int:
        """Return POS for an opening [m]; what the gripper cannot do is clipped.

        Raises:
            ConfigError: The opening is not finite.
        """
        if not np.isfinite(opening_m):
            raise ConfigError(f"gripper: an opening must be finite, got {opening_m}")
        share = 1 - float(np.clip(opening_m / self.maker.stroke_m, 0, 1))
        return round(self.open_count + share * (self.closed_count - self.open_count))

    def opening(self, position: int) -> float:
        """Return the opening [m] at POS."""
        share = (self.closed_count - position) / (self.closed_count - self.open_count)
        return float(np.clip(share, 0, 1)) * self.maker.stroke_m

    def force(self, force_n: float) -> int:
        """Return FOR for a force [N], clipped to what the gripper can do."""
        return _byte(force_n, self.maker.force_n, "force")

    def speed(self, speed_m_s: float) -> int:
        """Return SPE for a speed [m/s], clipped to what the gripper can do."""
        return _byte(speed_m_s, self.maker.speed_m_s, "speed")


def _byte(value: float, span: tuple[float, float], what: str) -> int:
    if not np.isfinite(value):
        raise ConfigError(f"gripper: a {what} must be finite, got {value}")
    low, high = span
    return round(255 * float(np.clip((value - low) / (high - low), 0, 1)))


@dataclass(frozen=True)
class GripperState:
    """What the gripper says of itself."""

    opening_m: float
    seen: Seen
    fault: int

    @property
    def has_object(self) -> bool:
        """Whether the fingers stopped at something while closing; pads that meet hold nothing."""
        return self.seen is Seen.STOPPED_CLOSING and self.opening_m > 0


class RobotiqGripper:
    """A gripper on its socket; every reply has to come in time.

    Args:
        host: The robot's controller, or what else serves the socket.
        port: 63352 unless forwarded.
        counts: Model, and what POS says when open and closed.
        force_n: What the fingers press with.
        speed_m_s: Of the fingers.
        timeout_s: For one reply.
        sleep: Waits between two looks.

    Raises:
        GripperSilent: Nothing listens there.
        ConfigError: A number is not finite.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        *,
        counts: Counts | None = None,
        force_n: float = 40.0,
        speed_m_s: float = 0.06,
        timeout_s: float = 0.5,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.counts = counts or Counts()
        self._force, self._speed = self.counts.force(force_n), self.counts.speed(speed_m_s)
        self._timeout_s = timeout_s
        self._sleep = sleep
        self._end_lines: set[re.Pattern[bytes]] = set()
        self._where = f"gripper at {host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise GripperSilent(
                f"nothing answers for the {self._where}: {error}; is the gripper's URCap installed and running?"
            ) from error

    def close(self) -> None:
        """Leave the socket; the fingers stay as they are."""
        self._socket.close()

    # -- registers ---------------------------------------------------------------------------------------------------

    def get(self, name: str) -> int:
        """Return a register's value.

        Raises:
            GripperSilent: No reply in time, or none that makes sense.
        """
        reply = self._request(f"GET {name}\n".encode("ascii"), _REPLY)
        if reply.group(1).decode() != name:
            raise GripperSilent(f"the {self._where} was asked for {name} and answered {reply.group(0)[:40]!r}")
        try:
            return int(reply.group(2))
        except ValueError as error:
            raise GripperSilent(
                f"the {self._where} answers {reply.group(0)[:40]!r} for {name}, which is no number; is the gripper "
                "connected to the robot?"
            ) from error

    def set(self, **values: int) -> None:
        """Set registers in one request.

        Raises:
            GripperSilent: It was not acknowledged in time.
        """
        words = " ".join(f"{name} {value}" for name, value in values.items())
        self._request(f"SET {words}\n".encode("ascii"), _ACK)

    def _request(self, line: bytes, expected: re.Pattern[bytes]) -> re.Match[bytes]:
        deadline = time.monotonic() + self._timeout_s
        try:
            self._drain()
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(line)
            reply = self._read(deadline, expected)
        except OSError as error:
            raise GripperSilent(f"the connection to the {self._where} broke: {error}") from error
        found = expected.fullmatch(reply.rstrip(b"\r\n\0 "))
        if found is None:
            said = f"answered {reply[:40]!r}" if reply else f"said nothing for {self._timeout_s:g} s"
            raise GripperSilent(f"the {self._where} {said} to {line.strip().decode()!r}")
        return found

    def _read(self, deadline: float, expected: re.Pattern[bytes]) -> bytes:
        """Read until a line ends, or what came so far makes sense and is followed by silence."""
        reply = b""
        while len(reply) < _LONGEST_REPLY and not reply.endswith(b"\n"):
            left = deadline - time.monotonic()
            whole = expected not in self._end_lines and expected.fullmatch(reply) is not None
            wait = min(left, _QUIET_S) if whole else left
            if wait <= 0 or not select.select([self._socket], [], [], wait)[0]:
                break
            part = self._socket.recv(_LONGEST_REPLY)
            if not part:
                raise ConnectionResetError("it was closed by the other side")
            reply += part
        if reply.endswith(b"\n"):
            self._end_lines.add(expected)
        return reply

    def _drain(self) -> None:
        """Throw away what came too late for the request before."""
        while select.select([self._socket], [], [], 0)[0]:
            if not self._socket.recv(4096):
                raise ConnectionResetError("it was closed by the other side")

    # -- the gripper -------------------------------------------------------------------------------------------------

    def state(self) -> GripperState:
        """Return opening, what the fingers met, and the fault code.

        Raises:
            GripperSilent: As `get`.
            GripperError: It reports a fault.
        """
        fault = self.get("FLT") & 0x0F
        if fault not in _HARMLESS:
            raise GripperError(f"the {self._where} reports fault {fault}: {FAULTS.get(fault, 'unknown')}")
        seen = self.get("OBJ")
        if seen not in tuple(Seen):
            raise GripperSilent(f"the {self._where} says OBJ {seen}, which means nothing")
        position = self.get("POS")
        if not 0 <= position <= 255:
            raise GripperSilent(f"the {self._where} says POS {position}, allowed are 0..255")
        return GripperState(self.counts.opening(position), Seen(seen), fault)

    def is_active(self) -> bool:
        """Whether it was activated since it was powered.

        Raises:
            GripperSilent: As `get`.
        """
        return self.get("STA") == _ACTIVE and self.get("ACT") == 1

    def activate(self, *, timeout_s: float = 10.0) -> None:
        """Activate it: THE FINGERS MOVE to both ends. Does nothing where it is active.

        Where that is interrupted it is reset, which stops the fingers.

        Raises:
            GripperSilent: As `get`, or it was not active in time.
            GripperError: It reports a fault.
        """
        if self.is_active():
            self.state()
            return
        self.set(ACT=0, ATR=0)
        self._until(lambda: self.get("STA") == 0, timeout_s, "reset")
        try:
            self.set(ACT=1)
            self._until(lambda: self.get("STA") == _ACTIVE, timeout_s, "active")
        except BaseException:  # an interrupt from the keyboard too
            with contextlib.suppress(GripperError):
                self.set(ACT=0)
            raise
        self.state()

    def move(self, opening_m: float, *, timeout_s: float = 6.0) -> GripperState:
        """Open or close to an opening [m] and wait until the fingers stand still.

        Where that fails or is interrupted, they are told to stop where they are.

        Returns:
            Where they stand, and whether something stopped them.

        Raises:
            GripperSilent: As `get`, or they did not come to rest in time.
            GripperError: It reports a fault, or is not active.
            ConfigError: The opening is not finite.
        """
        return self._go(self.counts.position(opening_m), timeout_s)

    def grip(self, *, timeout_s: float = 6.0) -> GripperState:
        """Close until something stops the fingers or they meet, and go on pressing; else like `move`."""
        return self._go(255, timeout_s)

    def _go(self, position: int, timeout_s: float) -> GripperState:
        if not self.is_active():
            raise GripperError(f"the {self._where} is not activated")
        try:
            self.set(POS=position, SPE=self._speed, FOR=self._force, GTO=1)
            self._until(lambda: self.get("PRE") == position, timeout_s, f"told to go to {position}")
            return self._at_rest(self.counts.opening(position), timeout_s)
        except BaseException:  # an interrupt from the keyboard too
            self.halt()
            raise

    def _at_rest(self, goal_m: float, timeout_s: float) -> GripperState:
        until: float | None = None
        states: list[GripperState] = []

        def rests() -> bool:
            nonlocal until
            states.append(self.state())
            at = states[-1]
            if at.seen is not Seen.AT_POSITION or abs(at.opening_m - goal_m) <= _NEAR_M:
                return at.seen is not Seen.MOVING
            until = time.monotonic() + _LATE_S if until is None else until
            if time.monotonic() > until:
                raise GripperError(
                    f"the {self._where} was told to go to {goal_m * 1e3:.0f} mm, says that it is there, and stands at "
                    f"{at.opening_m * 1e3:.0f} mm"
                )
            return False

        self._until(rests, timeout_s, "at rest")
        return states[-1]

    def still_holds(self, gripped: GripperState) -> bool:
        """Whether what stopped the fingers then stops them now, at the same opening.

        Raises:
            GripperSilent: As `get`.
            GripperError: It reports a fault.
        """
        now = self.state()
        return now.has_object and abs(now.opening_m - gripped.opening_m) <= STILL_HELD_M

    def halt(self) -> None:
        """Stop the fingers where they are; never raises, as it is for when something else went wrong."""
        with contextlib.suppress(GripperError):
            self.set(GTO=0)

    def _until(self, done: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() >= deadline:
                raise GripperSilent(f"the {self._where} was not {what} within {timeout_s:g} s")
            self._sleep(0.01)
