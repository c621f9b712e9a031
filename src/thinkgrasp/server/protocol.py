"""HTTP/1.1 on a socket: uvicorn's, with a time limit for headers, a limit of connections, and errors in JSON."""

from __future__ import annotations

import asyncio
import json
import uuid
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from thinkgrasp.server.limits import Limits


def bounded_protocol(limits: Limits) -> type[asyncio.Protocol]:
    """Return the protocol class for uvicorn's `http` setting.

    A connection that has not sent a request's headers in time is answered 408 and closed; one too many is answered
    429 and closed; one whose client does not take its answer in time is cut.
    """
    header_timeout_s, send_timeout_s, connections = limits.header_timeout_s, limits.send_timeout_s, limits.connections

    class BoundedProtocol(H11Protocol):
        _timer: asyncio.TimerHandle | None = None
        """Runs until the headers are there."""
        _sending: asyncio.TimerHandle | None = None
        """Runs while the client does not take what it is sent."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > connections:
                self._end(429, "too_many_connections", "too many connections are open", (("Retry-After", "1"),))
                return
            self._start()

        def data_received(self, data: bytes) -> None:
            if self.transport.is_closing():
                return
            waited = self.cycle is None or self.cycle.response_complete
            super().data_received(data)
            if not waited or (self.cycle is not None and not self.cycle.response_complete):
                self._stop()
            elif self._timer is None:
                self._start()

        def pause_writing(self) -> None:
            super().pause_writing()
            self._sending = self.loop.call_later(send_timeout_s, self.transport.abort)

        def resume_writing(self) -> None:
            self._taken()
            super().resume_writing()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop()
            self._taken()
            super().connection_lost(exc)

        def send_400_response(self, msg: str) -> None:
            self._end(400, "bad_http", "this is no HTTP/1.1 request that can be read")

        def _start(self) -> None:
            self._timer = self.loop.call_later(header_timeout_s, self._too_slow)

        def _stop(self) -> None:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

        def _taken(self) -> None:
            if self._sending is not None:
                self._sending.cancel()
                self._sending = None

        def _too_slow(self) -> None:
            self._timer = None
            if self.cycle is None or self.cycle.response_complete:
                self._end(408, "headers_too_slow", f"the request's headers took longer than {header_timeout_s:g} s")

        def _end(self, status: int, code: str, message: str, more: tuple[tuple[str, str], ...] = ()) -> None:
            """Answer past h11, whose state may not allow it any more, and close."""
            self._stop()
            if self.transport.is_closing():
                return
            if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
                self.transport.write(_answer(status, code, message, more))
            self.transport.close()

    return BoundedProtocol


def _answer(status: int, code: str, message: str, more: tuple[tuple[str, str], ...]) -> bytes:
    request_id = uuid.uuid4().hex
    error: dict[str, Any] = {"error": {"code": code, "message": message, "request_id": request_id}}
    body = json.dumps(error).encode()
    headers = (
        ("Content-Type", "application/json"),
        ("Content-Length", str(len(body))),
        ("X-Request-ID", request_id),
        ("Connection", "close"),
        *more,
    )
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", *(f"{name}: {value}" for name, value in headers)]
    return "\r\n".join([*lines, "", ""]).encode("ascii") + body
