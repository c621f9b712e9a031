"""The two sides of chat.completions as the emulator speaks it: what it reads of a request, and its replies."""

from __future__ import annotations

import base64
import io
import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, Field, ValidationError

from thinkgrasp.errors import InputError
from thinkgrasp.types import BoxXYXY

MODEL = "emulator"
"""What every reply names as its model."""
Format = Literal["text", "json_object", "json_schema"]

_MARK = re.compile(r"^mark (\d+): .*?\bbox (-?\d+) (-?\d+) (-?\d+) (-?\d+)", re.MULTILINE)
_TRIED = re.compile(r"^at mark (\d+): (.*)$", re.MULTILINE)
_CELL = re.compile(r"\bcell (\d+)")
_LEAVE = re.compile(r"no grasp is possible|leave it for later")
_REJECTED = re.compile(r"taking (.+?) \(mark (\d+)\) was tried and failed")


class _TextPart(BaseModel):
    type: Literal["text"]
    text: str


class _Url(BaseModel):
    url: str
    detail: str = "auto"


class _ImagePart(BaseModel):
    type: Literal["image_url"]
    image_url: _Url


_Part = Annotated[_TextPart | _ImagePart, Field(discriminator="type")]


class _Message(BaseModel):
    content: str | list[_Part] | None = None


class _Schema(BaseModel):
    properties: dict[str, object] = {}


class _NamedSchema(BaseModel):
    schema_: Annotated[_Schema, Field(alias="schema")]


class _ResponseFormat(BaseModel):
    type: Format = "text"
    json_schema: _NamedSchema | None = None


class _Body(BaseModel):
    messages: Annotated[list[_Message], Field(min_length=1)]
    response_format: _ResponseFormat = _ResponseFormat()
    stream: bool | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """What the emulator reads of a request."""

    text: str
    picture: NDArray[np.uint8]
    """(h, w, 3), the last one."""
    detail: str
    format: Format
    properties: tuple[str, ...]
    """Of the JSON schema, in its order; empty = not said."""

    @property
    def wants_pixel(self) -> bool:
        """Whether the reply is to name a pixel instead of a box and cells."""
        return "Grasp pixel:" in self.text

    @cached_property
    def marks(self) -> dict[int, BoxXYXY]:
        """Boxes [px of the picture] by mark."""
        found = [tuple(map(int, match.groups())) for match in _MARK.finditer(self.text)]
        return {mark: (x0, y0, x1, y1) for mark, x0, y0, x1, y1 in found}

    def failed_cells(self, mark: int | None) -> set[int]:
        """Return the cells of a mark that the text says failed."""
        return {int(cell) for of, tried in self._tried if of == mark for cell in _CELL.findall(tried)}

    @cached_property
    def left_marks(self) -> frozenset[int]:
        """Marks of things that the text says to leave."""
        rejected = (int(mark) for _, mark in _REJECTED.findall(self.text))
        return frozenset((*(mark for mark, tried in self._tried if _LEAVE.search(tried)), *rejected))

    @cached_property
    def left_names(self) -> frozenset[str]:
        """Names of earlier replies that were rejected because taking the thing failed."""
        return frozenset(name for name, _ in _REJECTED.findall(self.text))

    @cached_property
    def _tried(self) -> list[tuple[int, str]]:
        return [(int(mark), tried) for mark, tried in _TRIED.findall(self.text)]


def read_request(body: bytes) -> Request:
    """Read the body of a request.

    Raises:
        InputError: It is no chat.completions request with a picture, or asks for what the emulator does not know.
    """
    try:
        data = _Body.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "the body"
        raise InputError(f"no chat.completions request: {where}: {first['msg']}") from error
    if data.stream:
        raise InputError("stream is not supported")
    contents = [message.content for message in data.messages]
    parts = [part for c in contents if isinstance(c, list) for part in c]
    texts = [
        c if isinstance(c, str) else "\n".join(p.text for p in c or () if isinstance(p, _TextPart)) for c in contents
    ]
    images = [part.image_url for part in parts if isinstance(part, _ImagePart)]
    if not images:
        raise InputError("the request has no picture (image_url with a data URL)")
    schema = data.response_format.json_schema
    properties = tuple(schema.schema_.properties) if schema else ()
    picture = _decode(images[-1].url)
    return Request("\n".join(texts), picture, images[-1].detail, data.response_format.type, properties)


def _decode(url: str) -> NDArray[np.uint8]:
    head, comma, data = url.partition(",")
    if not (comma and head.startswith("data:image/") and head.endswith(";base64")):
        raise InputError("a picture must be a data URL: data:image/png;base64,...")
    try:
        with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as image:
            return np.asarray(image.convert("RGB"))
    except (ValueError, OSError, Image.DecompressionBombError) as error:
        raise InputError(f"the picture cannot be read: {error}") from error


@dataclass(frozen=True)
class Reply:
    """Status, headers and JSON body of a reply."""

    status: int
    body: Mapping[str, object]
    headers: tuple[tuple[str, str], ...] = ()
    tokens: tuple[int, int] = (0, 0)
    """Of the prompt and of the completion."""


def error_reply(status: int, code: str, message: str, headers: tuple[tuple[str, str], ...] = ()) -> Reply:
    """Return an error in the form that clients of chat.completions expect."""
    error = {"message": f"[{MODEL}] {message}", "type": code, "param": None, "code": code}
    return Reply(status, {"error": error}, headers)


def image_tokens(size_wh: tuple[int, int], detail: str) -> int:
    """Return what a picture counts, after the published rules of GPT-4o.

    85, and unless the detail is low another 170 per tile of 512 px after scaling to 768 px on the shorter side.
    """
    w, h = size_wh
    shrink = min(1.0, 2048 / max(h, w), 768 / min(h, w))
    tiles = 0 if detail == "low" else math.ceil(w * shrink / 512) * math.ceil(h * shrink / 512)
    return 85 + 170 * tiles


def completion(request: Request, index: int, text: str, *, is_refusal: bool = False) -> Reply:
    """Wrap words as a reply.

    The usage is made up: a token is 4 characters of text, a picture counts as `image_tokens`.
    """
    h, w = request.picture.shape[:2]
    prompt = math.ceil(len(request.text) / 4) + image_tokens((w, h), request.detail)
    reply = math.ceil(len(text) / 4)
    in_field = is_refusal and request.format == "json_schema"
    message = {
        "role": "assistant", "content": None if in_field else text, "refusal": text if in_field else None
    }  # fmt: skip
    body: dict[str, object] = {
        "id": f"{MODEL}-{index:06d}",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": MODEL,
        "system_fingerprint": MODEL,
        "choices": [{"index": 0, "message": message, "finish_reason": "stop", "logprobs": None}],
        "usage": {"prompt_tokens": prompt, "completion_tokens": reply, "total_tokens": prompt + reply},
    }
    return Reply(200, body, tokens=(prompt, reply))
