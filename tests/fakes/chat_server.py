"""A chat.completions server on a real socket that answers by script: well, badly, late, or not at all."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass(frozen=True)
class Step:
    """What the server does with one request."""

    status: int = 200
    body: bytes = b""
    headers: Mapping[str, str] = field(default_factory=lambda: {"Content-Type": "application/json"})
    hang: bool = False
    """Send nothing until the server stops."""
    drip_s: float = 0.0
    """Send the body byte by byte, with this pause between."""
    cut_at: int | None = None
    """Close the connection after so many bytes of the body."""


def good(content: object, *, usage: bool = True, model: str = "gpt-4o", **message: object) -> Step:
    """A completion with this text, or with this value as JSON."""
    text = content if isinstance(content, str) or content is None else json.dumps(content)
    data: dict[str, object] = {
        "id": "chatcmpl-1",
        "object": "chat.completion",
        "created": 0,
        "model": model,
        "choices": [
            {
                "index": 0,
                "finish_reason": "stop",
                "message": {"role": "assistant", "content": text, "refusal": None, **message},
            }
        ],
    }
    if usage:
        data["usage"] = {"prompt_tokens": 1000, "completion_tokens": 100, "total_tokens": 1100}
    return Step(body=json.dumps(data).encode())


def error(status: int, message: str = "out of order", *, code: str | None = None, **headers: str) -> Step:
    """An error reply as OpenAI writes it; headers by name with underscores."""
    body = json.dumps({"error": {"message": message, "type": "error", "param": None, "code": code}}).encode()
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Step(status, body, {"Content-Type": "application/json", **named})


@dataclass
class Request:
    """What arrived."""

    path: str
    headers: dict[str, str]
    """By lower-case name."""
    body: dict[str, Any]

    @property
    def text(self) -> str:
        """All words of the request, without the image."""
        parts: list[str] = []
        for message in self.body["messages"]:
            content = message["content"]
            parts += [content] if isinstance(content, str) else [p["text"] for p in content if p["type"] == "text"]
        return "\n".join(parts)


class ChatServer:
    """Answers request i by step i of its script, and every request after the last by the last."""

    def __init__(self, steps: Iterable[Step]) -> None:
        self.steps = list(steps)
        self.requests: list[Request] = []
        self._stopped = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = False
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    def close(self) -> None:
        self._stopped.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                server.requests.append(Request(self.path, {k.lower(): v for k, v in self.headers.items()}, body))
                step = server.steps[min(len(server.requests), len(server.steps)) - 1]
                if step.hang:
                    server._stopped.wait(5)
                    return
                self.send_response(step.status)
                for name, value in step.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(step.body)))
                self.end_headers()
                try:
                    self._send(step)
                except OSError:
                    return  # the client hung up

            def _send(self, step: Step) -> None:
                if not step.drip_s:
                    self.wfile.write(step.body[: step.cut_at])
                    return
                for byte in step.body:
                    self.wfile.write(bytes([byte]))
                    time.sleep(step.drip_s)

            def log_message(self, format: str, *args: object) -> None:
                pass

            def date_time_string(self, timestamp: float | None = None) -> str:
                return "Sun, 06 Nov 1994 08:49:37 GMT"

        return Handler


@contextmanager
def serving(*steps: Step) -> Iterator[ChatServer]:
    """Run a server while the block runs."""
    server = ChatServer(steps)
    try:
        yield server
    finally:
        server.close()


def dead_url() -> str:
    """An address where nothing listens."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{s.getsockname()[1]}/v1"
