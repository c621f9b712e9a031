"""The requests that a client can make of a server, each described once."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from PIL import Image
from pydantic import BaseModel

from thinkgrasp.errors import InputError
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.schema import EpisodeAnswer, ExplainedDecision, Readiness
from thinkgrasp.types import Frame

Part = tuple[str, bytes, str]
"""Of a multipart body: file name, content, content type."""
_T = TypeVar("_T", bound=BaseModel)


@dataclass(frozen=True)
class Call(Generic[_T]):
    """One request, and what its answer is read as."""

    method: str
    path: str
    answer: type[_T]
    files: Mapping[str, Part] | None = None
    body: Mapping[str, object] | None = None


READY_CALL = Call("GET", "/readyz", Readiness)


def grasp_call(frame: Frame, instruction: str, options: Mapping[str, object]) -> Call[DecisionModel]:
    """Return the request for one decision."""
    return Call("POST", "/v1/grasp", DecisionModel, {**frame_parts(frame, options), "instruction": _text(instruction)})


def explain_call(frame: Frame, instruction: str, options: Mapping[str, object]) -> Call[ExplainedDecision]:
    """Return the request for one decision with its pictures."""
    return Call(
        "POST", "/v1/explain", ExplainedDecision, {**frame_parts(frame, options), "instruction": _text(instruction)}
    )


def begin_call(instruction: str, step_limit: int) -> Call[EpisodeAnswer]:
    """Return the request that opens an episode."""
    return Call("POST", "/v1/episodes", EpisodeAnswer, body={"instruction": instruction, "step_limit": step_limit})


def observe_call(episode: str, frame: Frame, more_views: bool, options: Mapping[str, object]) -> Call[EpisodeAnswer]:
    """Return the request for an episode's next decision."""
    parts = {**frame_parts(frame, options), "more_views": _json_part(more_views)}
    return Call("POST", f"/v1/episodes/{episode}/observe", EpisodeAnswer, parts)


def stop_call(episode: str) -> Call[EpisodeAnswer]:
    """Return the request that ends an episode."""
    return Call("DELETE", f"/v1/episodes/{episode}", EpisodeAnswer)


def outcome_call(
    episode: str, success: bool, reason: str | None, delivered: bool | None, after: Frame | None
) -> Call[EpisodeAnswer]:
    """Return the request that reports an outcome."""
    path = f"/v1/episodes/{episode}/outcome"
    said: dict[str, object] = {"success": success, "reason": reason, "delivered": delivered}
    said = {name: value for name, value in said.items() if value is not None}
    if after is None:
        return Call("POST", path, EpisodeAnswer, body=said)
    words = {name: _text(v) if isinstance(v, str) else _json_part(v) for name, v in said.items()}
    return Call("POST", path, EpisodeAnswer, {**frame_parts(after, {}), **words})


def frame_parts(frame: Frame, options: Mapping[str, object]) -> dict[str, Part]:
    """Return a frame and options as parts of a multipart body, from which the server makes the same frame."""
    camera: dict[str, object] = {n: getattr(frame.camera, n) for n in ("width", "height", "fx", "fy", "cx", "cy")}
    if frame.T_world_camera is not None:
        camera["T_world_camera"] = frame.T_world_camera.tolist()
    depth = io.BytesIO()
    np.save(depth, np.nan_to_num(frame.depth, nan=0.0, posinf=0.0, neginf=0.0), allow_pickle=False)
    parts: dict[str, Part] = {
        "color": ("color.png", _png(Image.fromarray(frame.color)), "image/png"),
        "depth": ("depth.npy", depth.getvalue(), "application/octet-stream"),
        "camera": _json_part(camera),
    }
    if frame.workspace is not None:
        parts["workspace"] = ("workspace.png", _png(Image.fromarray(frame.workspace)), "image/png")
    if options:
        parts["options"] = _json_part(dict(options))
    return parts


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _json_part(value: object) -> Part:
    try:
        return ("part.json", json.dumps(value, allow_nan=False).encode(), "application/json")
    except (TypeError, ValueError) as error:
        raise InputError(f"an option cannot be sent: {error}") from error


def _text(words: str) -> Part:
    try:
        return ("part.txt", words.encode("utf-8"), "text/plain; charset=utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"the instruction is no valid text: {error}") from error
