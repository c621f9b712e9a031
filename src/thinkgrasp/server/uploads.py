"""A request's body: read within bounds of size and time, and turned into models, whether multipart or JSON."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncGenerator
from typing import Any, TypeVar

from pydantic import BaseModel
from python_multipart.multipart import parse_options_header
from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from thinkgrasp.server.limits import Limits
from thinkgrasp.server.problems import ClientLeft, RequestProblem

FILES = ("color", "depth", "workspace")
JSON_PARTS = ("camera", "options", "more_views", "success", "delivered")
MAX_PARTS = 16
MAX_TEXT_PART_BYTES = 200_000
MAX_DEPTH = 40
"""Nesting of JSON."""
MAX_VALUES = 5000
"""Values in a JSON text, which cost a hundred times their bytes; base64 holds none of what separates them."""
MAX_WORDS_BYTES = 100_000
"""A body that holds no frame."""
LINGER_BYTES = 4_000_000
LINGER_S = 1.0
"""So much of a body that is refused is still read."""

_BOUNDARY = re.compile(rb"[0-9A-Za-z'()+_,./:=? -]{1,70}")
_M = TypeVar("_M", bound=BaseModel)


async def read_body(request: Request, limits: Limits, *, max_bytes: int | None = None) -> bytes:
    """Read a request's whole body of at most `max_bytes`; None = what the limits say.

    Raises:
        RequestProblem: It is too large (413), comes too slowly (408) or compressed (415).
        ClientLeft: The connection ended before the body.
    """
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding != "identity":
        raise RequestProblem(415, "compressed_body", "the body must not be compressed (Content-Encoding)")
    allowed = limits.body_bytes if max_bytes is None else min(max_bytes, limits.body_bytes)
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > allowed:
        await linger(request)
        raise _too_large(allowed)
    body = bytearray()
    try:
        async with asyncio.timeout(limits.body_timeout_s):
            while True:
                message = await request.receive()
                if message["type"] == "http.disconnect":
                    raise ClientLeft
                body += message.get("body", b"")
                if len(body) > allowed:
                    await linger(request)
                    raise _too_large(allowed)
                if not message.get("more_body", False):
                    return bytes(body)
    except TimeoutError:
        said = f"the body took longer than {limits.body_timeout_s:g} s"
        raise RequestProblem(408, "body_too_slow", said, {"Connection": "close"}) from None


async def read_model(request: Request, model: type[_M], limits: Limits) -> _M:
    """Read a body into a model, by its content type.

    Raises:
        RequestProblem: As `read_body`; 400 where it cannot be parsed, 415 for another type.
        ClientLeft: As `read_body`.
        ValidationError: The parts are not what the model wants.
    """
    kind = _kind(request)
    if kind not in ("application/json", "multipart/form-data"):
        await linger(request)
        raise _unsupported("multipart/form-data and application/json")
    body = await read_body(request, limits)
    if kind == "application/json":
        return model.model_validate(read_json_object(body))
    return model.model_validate(await _parts(request, body))


async def read_json(request: Request, model: type[_M], limits: Limits) -> _M:
    """Read a JSON body that holds no frame into a model; raises as `read_model`."""
    if _kind(request) != "application/json":
        await linger(request)
        raise _unsupported("application/json")
    return model.model_validate(read_json_object(await read_body(request, limits, max_bytes=MAX_WORDS_BYTES)))


def read_json_object(text: bytes, what: str = "the body") -> dict[str, Any]:
    """Parse a JSON object; numbers that JSON does not know are refused.

    Raises:
        RequestProblem: 400; it is no JSON, or no object.
    """
    value = _read_json(text, what)
    if not isinstance(value, dict):
        raise RequestProblem(400, "bad_json", f"{what} must be a JSON object")
    return value


async def read_parts(request: Request, limits: Limits) -> dict[str, bytes]:
    """Return the parts of a multipart body by name; raises as `read_model`."""
    return await _raw_parts(request, await read_body(request, limits))


async def _parts(request: Request, body: bytes) -> dict[str, Any]:
    """Return the parts of a multipart body as values for a model."""
    values: dict[str, Any] = {}
    for name, part in (await _raw_parts(request, body)).items():
        if name in FILES:
            values[name] = part
        elif name in JSON_PARTS:
            values[name] = _read_json(part, f"the part {name!r}")
        else:
            values[name] = as_text(part, name)
    return values


def as_text(part: bytes, name: str) -> str:
    """Return a part's text.

    Raises:
        RequestProblem: 400; it is no UTF-8.
    """
    try:
        return part.decode("utf-8")
    except UnicodeDecodeError:
        raise RequestProblem(400, "bad_text", f"the part {name!r} is no UTF-8 text") from None


class _InMemory(MultiPartParser):
    """Keeps files in memory: the body lies there already, and pictures do not belong on the disk."""

    spool_max_size = 2**40


async def _raw_parts(request: Request, body: bytes) -> dict[str, bytes]:
    async def stream() -> AsyncGenerator[bytes, None]:
        yield body

    boundary = parse_options_header(request.headers.get("content-type", ""))[1].get(b"boundary", b"")
    if not _BOUNDARY.fullmatch(boundary):
        raise RequestProblem(400, "bad_multipart", "the content type names no boundary that multipart may have")
    # Latin-1 takes every byte, so that what the parser makes a text of is had back as it came.
    headers = Headers({"Content-Type": f'multipart/form-data; boundary="{boundary.decode("ascii")}"; charset=latin-1'})
    parser = _InMemory(headers, stream(), max_files=MAX_PARTS, max_fields=MAX_PARTS, max_part_size=MAX_TEXT_PART_BYTES)
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise RequestProblem(400, "bad_multipart", f"the multipart body cannot be read: {error.message}") from None
    parts: dict[str, bytes] = {}
    try:
        for name, value in form.multi_items():
            if name in parts:
                raise RequestProblem(400, "bad_multipart", "a part occurs twice")
            parts[name] = await value.read() if isinstance(value, UploadFile) else value.encode("latin-1")
    finally:
        await form.close()
    if not parts:
        raise RequestProblem(400, "bad_multipart", "the multipart body holds no part")
    return parts


def _read_json(text: bytes, what: str) -> object:
    if sum(map(text.count, (b",", b"[", b"{"))) > MAX_VALUES:
        raise RequestProblem(400, "bad_json", f"{what} holds more than {MAX_VALUES} values")
    try:
        value: object = json.loads(text, parse_constant=_refuse_constant)
        if _is_deep(value, MAX_DEPTH):
            raise ValueError("it is nested too deeply")
    except (ValueError, RecursionError):
        raise RequestProblem(400, "bad_json", f"{what} is not readable as JSON") from None
    return value


def _refuse_constant(name: str) -> object:
    raise ValueError(f"{name} is no number of JSON")


def _is_deep(value: object, allowed: int) -> bool:
    if isinstance(value, dict):
        return allowed == 0 or any(_is_deep(v, allowed - 1) for v in value.values())
    if isinstance(value, list):
        return allowed == 0 or any(_is_deep(v, allowed - 1) for v in value)
    return False


async def linger(request: Request) -> None:
    """Read away a little of a body that nobody wants, so that its client comes to read the answer."""
    read = 0
    try:
        async with asyncio.timeout(LINGER_S):
            while read < LINGER_BYTES:
                message = await request.receive()
                read += len(message.get("body", b""))
                if message["type"] == "http.disconnect" or not message.get("more_body", False):
                    return
    except TimeoutError:
        return


def _kind(request: Request) -> str:
    kind, _ = parse_options_header(request.headers.get("content-type", ""))
    return kind.decode("latin-1").strip().lower()


def _unsupported(allowed: str) -> RequestProblem:
    return RequestProblem(415, "unsupported_media_type", f"the body must be {allowed}")


def _too_large(allowed: int) -> RequestProblem:
    said = f"the body is larger than the {allowed / 1e6:g} MB allowed"
    return RequestProblem(413, "too_large", said, {"Connection": "close"})
