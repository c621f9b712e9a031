"""What is asked of a chat model, what it answers, and that it may not."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thinkgrasp.types import Degradation

Detail = Literal["auto", "low", "high"]
ReplyFormat = Literal["json_schema", "json_object", "text"]
FORMATS: tuple[ReplyFormat, ...] = ("json_schema", "json_object", "text")
"""How a reply can be held to a schema, strictest first; the last is in words only."""

JPEG_QUALITY = 92


@dataclass(frozen=True, eq=False)
class Question:
    """One image and its text for one model, with what was wrong with the replies so far."""

    model: str
    system: str
    text: str
    image: NDArray[np.uint8]
    """(h, w, 3) RGB."""
    schema: dict[str, object] | None = None
    """JSON schema that the reply has to fit; None = free text."""
    temperature: float | None = 0.0
    """None = the server's own."""
    detail: Detail = "auto"
    corrections: tuple[tuple[str, str], ...] = ()
    """(reply, what was wrong with it), oldest first."""

    def again(self, reply: str, problem: str) -> Question:
        """Return the same question, followed by a reply to it and a request to mend that."""
        return replace(self, corrections=(*self.corrections, (reply, problem)))

    @cached_property
    def jpeg(self) -> bytes:
        """The image as it is sent."""
        buffer = io.BytesIO()
        Image.fromarray(self.image).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        return buffer.getvalue()

    @cached_property
    def image_digest(self) -> str:
        """SHA-256 of the image's size and pixels, which no encoder's version changes."""
        h, w = self.image.shape[:2]
        return hashlib.sha256(f"{w}x{h}:".encode() + np.ascontiguousarray(self.image).tobytes()).hexdigest()

    def summary(self) -> dict[str, object]:
        """Return what decides the reply, as JSON values, the image by its digest."""
        return {
            "model": self.model,
            "system": self.system,
            "text": self.text,
            "image": self.image_digest,
            "schema": self.schema,
            "temperature": self.temperature,
            "detail": self.detail,
            "corrections": [list(c) for c in self.corrections],
        }

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the summary; equal questions have equal digests in every process."""
        canonical = json.dumps(self.summary(), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
        return hashlib.sha256(canonical.encode()).hexdigest()

    def body(self, reply_format: ReplyFormat, *, with_temperature: bool = True) -> dict[str, object]:
        """Return the request of a chat completion, with the reply held to the schema in this way."""
        text = self.text
        if self.schema is not None and reply_format != "json_schema":
            text += "\n\nReply with one JSON object and nothing else. Its JSON schema: " + json.dumps(self.schema)
        image_url = {"url": "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode()}
        if self.detail != "auto":
            image_url["detail"] = self.detail
        messages: list[dict[str, object]] = [
            {"role": "system", "content": self.system},
            {
                "role": "user",
                "content": [{"type": "text", "text": text}, {"type": "image_url", "image_url": image_url}],
            },
        ]
        for reply, problem in self.corrections:
            messages.append({"role": "assistant", "content": reply})
            messages.append({"role": "user", "content": _correction(problem)})
        body: dict[str, object] = {"model": self.model, "messages": messages}
        if self.temperature is not None and with_temperature:
            body["temperature"] = self.temperature
        if self.schema is not None and reply_format == "json_schema":
            wanted = {"name": "plan", "schema": self.schema, "strict": True}
            body["response_format"] = {"type": "json_schema", "json_schema": wanted}
        elif self.schema is not None and reply_format == "json_object":
            body["response_format"] = {"type": "json_object"}
        return body


def _correction(problem: str) -> str:
    return (
        f"That reply cannot be used: {problem}\n"
        "Answer the same question about the same image once more, complete and in the same format."
    )


@dataclass(frozen=True)
class Answer:
    """What a model replied, and what asking took."""

    text: str
    model: str
    prompt_tokens: int | None
    """None where the server did not say."""
    completion_tokens: int | None
    refusal: str | None = None
    """The model's words where it refused."""
    requests: int = 1
    latency_s: float = 0.0
    """From the question to the answer, retries and waits included."""
    notes: tuple[Degradation, ...] = ()


class Unanswered(Exception):
    """No answer came; the message says why, in words that can be shown."""

    def __init__(self, reason: str, *, requests: int = 0, latency_s: float = 0.0) -> None:
        super().__init__(reason)
        self.reason = reason
        self.requests = requests
        self.latency_s = latency_s


class Chat(Protocol):
    """Whatever answers questions: a server, or a recording of one."""

    def ask(self, question: Question, deadline: float) -> Answer:
        """Return the answer, or raise Unanswered at the latest about when the clock shows `deadline` [s]."""
        ...

    def close(self) -> None:
        """Let go of connections and files."""
        ...


class Mute:
    """Answers nothing, for one reason."""

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def ask(self, question: Question, deadline: float) -> Answer:
        """Raise Unanswered."""
        raise Unanswered(self._reason)

    def close(self) -> None:
        """Nothing is open."""
