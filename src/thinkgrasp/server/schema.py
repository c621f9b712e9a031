"""What goes over the wire: requests, answers and errors, checked on the way in and documented in OpenAPI.

A frame comes as multipart parts or as JSON with base64; both are read into the same models.
"""

from __future__ import annotations

import base64
import binascii
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, WithJsonSchema, model_validator

from thinkgrasp.pipeline import MAX_INSTRUCTION_CHARS
from thinkgrasp.schema import DEFAULT_STANDOFF_M, MAX_ALTERNATIVES, DecisionModel, Finite


def _decoded(value: object) -> object:
    """Return bytes for base64 text; what is neither text nor bytes is left for the model to refuse."""
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value.encode("ascii"), validate=True)
    except (binascii.Error, UnicodeEncodeError):
        raise ValueError("must be base64 (standard alphabet, padded, without line breaks)") from None


FileBytes = Annotated[
    bytes,
    BeforeValidator(_decoded),
    Field(min_length=1),
    WithJsonSchema({"type": "string", "contentEncoding": "base64", "minLength": 4}),
]
"""A file: a part of a multipart body, or base64 in JSON."""

Instruction = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=MAX_INSTRUCTION_CHARS, pattern=r"\S")
]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)


class Options(_Model):
    """Everything that a client may set; all other settings are the server's."""

    depth_scale: Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)] | None = None
    """Metres per unit of the depth image; overrides the camera's."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    """Seed of everything random in this decision."""
    n_nearest: Annotated[int, Field(ge=1, le=1000)] | None = None
    """How many grasps nearest to the preferred point compete on score."""
    standoff_m: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = DEFAULT_STANDOFF_M
    """How far back along the approach the pre-grasp lies."""
    alternatives: Annotated[int, Field(ge=0, le=MAX_ALTERNATIVES)] = MAX_ALTERNATIVES
    """At most so many alternatives in the answer."""
    mask: bool = True
    """Whether the target's mask is in the answer."""


class FrameBody(_Model):
    """One aligned RGB-D view."""

    color: FileBytes
    """Colour image: PNG, JPEG, TIFF, WebP, BMP or .npy."""
    depth: FileBytes
    """Depth image aligned to it: 16-bit PNG or TIFF, float TIFF, or .npy."""
    camera: dict[str, Any]
    """Intrinsics as in a camera file: width, height, fx, fy, cx, cy, optional depth_scale and T_world_camera."""
    workspace: FileBytes | None = None
    """Image of the same size; non-zero = grasping is allowed."""
    options: Options = Options()


class GraspBody(FrameBody):
    """A frame and what to take from it."""

    instruction: Instruction
    """What to take, for example "the red box"."""


class ObserveBody(FrameBody):
    """What the camera of an episode sees now."""

    more_views: bool = False
    """Another view of the same scene follows if this one shows no grasp, so that the episode does not end with it."""


class EpisodeBody(_Model):
    """What an episode is to reach."""

    instruction: Instruction
    """What to take, for example "I need a fruit"."""
    step_limit: Annotated[int, Field(ge=1, le=1000)] = 15
    """At most so many attempts."""


class OutcomeBody(_Model):
    """What became of the grasp that was decided last."""

    success: bool
    reason: Annotated[str, StringConstraints(min_length=1, max_length=60, pattern=r"^[a-z][a-z0-9_]*$")] | None = None
    """Named reason: "held", "missed", "slipped", "unreachable", "collision", or your own; None = "held" or "missed"."""
    delivered: bool | None = None
    """Whether the goal lies in the bin, as whoever watches says; None: a successful attempt at the goal counts."""
    color: FileBytes | None = None
    """With depth and camera: what is seen now, to verify a success; the next frame verifies it otherwise."""
    depth: FileBytes | None = None
    camera: dict[str, Any] | None = None
    options: Options = Options()

    @model_validator(mode="after")
    def _is_whole(self) -> OutcomeBody:
        given = [part is not None for part in (self.color, self.depth, self.camera)]
        if any(given) and not all(given):
            raise ValueError("color, depth and camera come together or not at all")
        if self.delivered and not self.success:
            raise ValueError("a failed attempt delivers nothing: success is false, but delivered is true")
        return self


class ExplainedDecision(_Model):
    """A decision with what a person wants to see of it."""

    decision: DecisionModel
    overlay_png: str
    """The annotated picture, PNG in base64."""
    view_html: str
    """The 3-D view, one page that needs no network."""

    def overlay_bytes(self) -> bytes:
        """Return the annotated picture as a PNG file's content."""
        return base64.b64decode(self.overlay_png)


class EpisodeAnswer(_Model):
    """Where an episode stands, and what it waits for."""

    episode: str
    """Its id: whoever knows it may use the episode."""
    state: Literal["observe", "act", "ended"]
    """What is to come next: a frame, the outcome of the grasp, or nothing."""
    end: str | None
    """Named reason of the end."""
    success: bool
    """Whether the goal was delivered."""
    instruction: str
    attempts: Annotated[int, Field(ge=0)]
    step_limit: int
    expires_s: Finite
    """Without a request for so long it is forgotten."""
    undone: bool = False
    """The frame shows what was said to be removed where it was, so that the last attempt counts as failed."""
    verified: bool | None = None
    """Whether a frame shows that the target is gone from its place; None where none was sent, or where it cannot tell:
    it is of another view, or has no depth there."""
    decision: DecisionModel | None = None


class PaperPose(_Model):
    """A grasp as the paper's server returns it: camera optical frame [m], GraspNet's axes.

    Column 0 of `rot` is the approach, column 1 the closing direction; the fingertips are at xyz + dep * rot[:, 0].
    """

    xyz: tuple[Finite, Finite, Finite]
    rot: tuple[tuple[Finite, Finite, Finite], tuple[Finite, Finite, Finite], tuple[Finite, Finite, Finite]]
    dep: Finite


class PaperError(_Model):
    """Why there is no grasp."""

    error: str


class Problem(_Model):
    """What was wrong, in words and by a name that programs can test."""

    code: str
    message: str
    request_id: str


class ErrorBody(_Model):
    """The body of every answer that is not a success."""

    error: Problem


class Health(_Model):
    """The server's process answers."""

    status: Literal["ok"] = "ok"
    version: str


class Readiness(_Model):
    """Whether a decision could start."""

    ready: bool
    workers: int
    """Processes that make decisions; 0 = the server's own."""
    ready_workers: int
