"""An emulator of a vision-language model: chat.completions over HTTP, answered from the simulator's truth.

No model is behind it. It shows how the closed loop does with a model that is right as often as one says, and lets the
whole path (picture, prompt, HTTP, parsing) run without a key. Every reply says that it is an emulator's; no preset
uses it. Text that lists marks ("mark 3: ... box 10 20 60 80", pixels of the picture sent) is answered as JSON, a
picture with an instruction alone in lines of text, unless `response_format` asks for JSON.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Literal

import numpy as np

from thinkgrasp.benchmark.chat import MODEL, Format, Reply, completion, error_reply, read_request
from thinkgrasp.benchmark.picture_answer import PictureAnswer
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.testbed import Session
from thinkgrasp.types import Role

MAX_REQUEST_BYTES = 50_000_000

Kind = Literal["right", "wrong", "malformed", "refused", "rate_limited", "bad_request"]


@dataclass(frozen=True)
class Quality:
    """How good the emulated model is; rates are probabilities 0..1 per request.

    Raises:
        ConfigError: A rate lies outside 0..1, or a time is negative.
    """

    accuracy: float = 1.0
    """Of naming the right thing to take; else another one that is seen and no goal, called by its own name."""
    wrong_cell: float = 0.0
    """Of another cell than the best, or of any pixel in the thing's box."""
    malformed: float = 0.0
    """Empty, cut off, not of the format asked for, or without any answer."""
    refusal: float = 0.0
    rate_limited: float = 0.0
    """Status 429 with Retry-After, as of a server that is asked too often."""
    delay_s: float = 0.0
    retry_after_s: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value, is_time = getattr(self, field.name), field.name.endswith("_s")
            if not (0 <= value <= (math.inf if is_time else 1) and math.isfinite(value)):
                allowed = "a time of at least 0 s" if is_time else "a probability 0..1"
                raise ConfigError(f"emulator: {field.name} must be {allowed}, got {value}")


@dataclass(frozen=True)
class Served:
    """What became of one request."""

    kind: Kind
    taken: int | None = None
    """Index of the object that the reply was about."""
    role: Role = "goal"
    prompt_tokens: int = 0
    """As the reply says, made up."""
    completion_tokens: int = 0


class VlmEmulator:
    """Serves on a free port of this machine only, between `with` and its end.

    Answers depend on the seed and on the number of the request in the order of arrival. The world has to stand still
    while a request is answered, as it does where the one who asks waits for the reply.

    Args:
        session: Its world, views and goals are the truth.
        quality: Of the emulated model.
        grid: Cells per side that the prompt speaks of.
        formats: Response formats that the server knows; others are answered with status 400.
        seed: Of all that is left to chance.

    Raises:
        ConfigError: The grid or the seed is out of range.
    """

    def __init__(
        self,
        session: Session,
        quality: Quality | None = None,
        *,
        grid: int = 3,
        formats: Collection[Format] = ("text", "json_object", "json_schema"),
        seed: int = 0,
    ) -> None:
        if not 1 <= grid <= 15 or seed < 0:
            raise ConfigError(f"emulator: grid must be within 1..15 and seed at least 0, got {grid} and {seed}")
        self.quality = quality or Quality()
        self.served: list[Served] = []
        """Every request that was answered, oldest first."""
        self._session = session
        self._grid = grid
        self._formats = frozenset(formats)
        self._seed = seed
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    @property
    def base_url(self) -> str:
        """What clients of chat.completions take as their base_url."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    def __enter__(self) -> VlmEmulator:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def answer(self, body: bytes) -> Reply:
        """Answer the body of one request."""
        with self._lock:
            index = len(self.served)
            try:
                reply, served = self._answer(body, index)
            except InputError as error:
                reply, served = error_reply(400, "invalid_request_error", str(error)), Served("bad_request")
            prompt_tokens, completion_tokens = reply.tokens
            self.served.append(replace(served, prompt_tokens=prompt_tokens, completion_tokens=completion_tokens))
        self._closing.wait(self.quality.delay_s)
        return reply

    def _answer(self, body: bytes, index: int) -> tuple[Reply, Served]:
        request, quality = read_request(body), self.quality
        if request.format not in self._formats:
            known = ", ".join(sorted(self._formats))
            raise InputError(f"response_format {request.format!r} is not supported; supported are {known}")
        rng = np.random.default_rng([self._seed, index])
        limited, refused, malformed, accurate, misplaced = rng.random(5)
        if limited < quality.rate_limited:
            wait = (("Retry-After", f"{quality.retry_after_s:g}"),)
            return error_reply(429, "rate_limit_exceeded", "too many requests", wait), Served("rate_limited")
        if refused < quality.refusal:
            words = "I'm sorry, but I can't help with that."
            return completion(request, index, words, is_refusal=True), Served("refused")
        picture = PictureAnswer(self._session, request, self._grid)
        is_right = accurate < quality.accuracy
        said = picture.right() if is_right else picture.wrong(rng)
        if said is not None and misplaced < quality.wrong_cell:
            x0, y0, x1, y1 = said.box
            others = [cell for cell in range(1, self._grid**2 + 1) if cell != said.cell] or [said.cell]
            pixel = int(rng.integers(x0, x1)), int(rng.integers(y0, y1))
            said = replace(said, cell=int(rng.choice(others)), pixel=pixel)
        text = picture.words(said)
        served = Served("right" if is_right else "wrong")
        if said is not None:
            served = replace(served, taken=said.taken, role=said.role)
        if malformed < quality.malformed:
            text, served = _spoilt(text, rng), replace(served, kind="malformed")
        return completion(request, index, text), served


def _spoilt(text: str, rng: np.random.Generator) -> str:
    """Return a reply as bad models give it."""
    bad = ("", text[: len(text) // 3], "Sure! I looked at the picture and thought about it.", '{"answer": [1, 2')
    return bad[int(rng.integers(len(bad)))]


def _handler(emulator: VlmEmulator) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        server_version = f"thinkgrasp-{MODEL}"
        sys_version = ""
        timeout = 60

        def do_GET(self) -> None:
            if self.path.rstrip("/") == "/v1/models":
                model = {"id": MODEL, "object": "model", "created": 0, "owned_by": MODEL}
                self._send(Reply(200, {"object": "list", "data": [model]}))
            else:
                self._send(error_reply(404, "not_found", f"there is no {self.path}"))

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdecimal() or int(length) > MAX_REQUEST_BYTES:
                self.close_connection = True
                self._send(
                    error_reply(413, "request_too_large", f"at most {MAX_REQUEST_BYTES} bytes, and their number")
                )
                return
            body = self.rfile.read(int(length))
            if self.path.rstrip("/") == "/v1/chat/completions":
                self._send(emulator.answer(body))
            else:
                self._send(error_reply(404, "not_found", f"there is no {self.path}"))

        def _send(self, reply: Reply) -> None:
            data = json.dumps(reply.body).encode()
            headers = (("Content-Type", "application/json"), ("Content-Length", str(len(data))), *reply.headers)
            try:
                self.send_response(reply.status)
                for name, value in headers:
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(data)
            except ConnectionError:
                self.close_connection = True  # who asked did not wait

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    return Handler
