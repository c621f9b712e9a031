"""The Decision as JSON: one versioned schema for the command line, the server and the recorder.

All positions, rotations and the preferred point share one frame: "world" when the camera pose is known, else "camera".
"""

from __future__ import annotations

import base64
import binascii
import io
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field

from thinkgrasp import __version__
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, quat_wxyz
from thinkgrasp.types import Decision, Grasp, Mask, Segment

DECISION_SCHEMA = "thinkgrasp/decision-1"
CONVENTION = "z-approach x-closing tcp"
DEFAULT_STANDOFF_M = 0.10
"""How far back along the approach the pre-grasp lies."""
MAX_ALTERNATIVES = 10

Finite = Annotated[float, Field(allow_inf_nan=False)]
Unit = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[Finite, Finite, Finite]
Box = tuple[int, int, int, int]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class DegradationModel(_Model):
    """One fallback that was taken."""

    stage: str
    reason: str
    fallback: str


class PlannedObjectModel(_Model):
    """One object the planner considered."""

    name: str
    grasp_score: Annotated[float, Field(ge=0, le=100)]
    cell: int | None


class PlanModel(_Model):
    """What to take now, where, and why."""

    target: str
    kind: Literal["object", "part"]
    role: Literal["goal", "obstruction"]
    mark: int | None
    grid: Annotated[int, Field(ge=1)]
    cell: Annotated[int, Field(ge=1)]
    crop_xyxy: Box | None
    objects: tuple[PlannedObjectModel, ...]
    rationale: str


class TargetModel(_Model):
    """The segment that was chosen; `mask_png` is a 1-bit PNG of the image's size in base64."""

    label: str
    score: Finite
    box_xyxy: Box
    mask_png: str | None
    touches_border: bool


class GraspModel(_Model):
    """One two-finger grasp: +z approach, +x closing, origin midway between the fingertips."""

    frame: Literal["camera", "world"]
    position_m: Vector
    quat_wxyz: tuple[Finite, Finite, Finite, Finite]
    rotation: tuple[Vector, Vector, Vector]
    width_m: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    score: Unit
    pregrasp_position_m: Vector
    convention: Literal["z-approach x-closing tcp"] = CONVENTION


class FunnelModel(_Model):
    """How many grasps went into a check and how many came out."""

    check: str
    n_in: Annotated[int, Field(ge=0, alias="in")]
    n_out: Annotated[int, Field(ge=0, alias="out")]


class TimingsModel(_Model):
    """Wall time by stage; 0 for a stage that was not reached."""

    scene: Finite = 0.0
    plan: Finite = 0.0
    segment: Finite = 0.0
    generate: Finite = 0.0
    check: Finite = 0.0
    select: Finite = 0.0
    total: Finite = 0.0


class UsageModel(_Model):
    """What the planner's model spent."""

    model: str | None
    prompt_tokens: int
    completion_tokens: int
    usd: float | None
    requests: int


class DecisionModel(_Model):
    """The answer to one frame and one sentence."""

    schema_: Annotated[Literal["thinkgrasp/decision-1"], Field(alias="schema")] = DECISION_SCHEMA
    status: Literal["grasp", "no_target", "no_grasp"]
    instruction: str
    degraded: tuple[DegradationModel, ...]
    plan: PlanModel
    target: TargetModel | None
    preferred_point_m: Vector | None
    grasp: GraspModel | None
    alternatives: Annotated[tuple[GraspModel, ...], Field(max_length=MAX_ALTERNATIVES)]
    funnel: tuple[FunnelModel, ...]
    timings_ms: TimingsModel
    usage: UsageModel
    version: str

    def to_json(self, indent: int | None = None) -> str:
        """Return the JSON text with the published key names."""
        return self.model_dump_json(by_alias=True, indent=indent)


def decision_to_schema(
    decision: Decision, *, standoff_m: float = DEFAULT_STANDOFF_M, with_mask: bool = True
) -> DecisionModel:
    """Turn a decision into its published form.

    Args:
        decision: What the pipeline returned.
        standoff_m: Distance [m] of the pre-grasp from the grasp, back along the approach.
        with_mask: Whether to include the target's mask as PNG.
    """
    T = decision.scene.frame.T_world_camera
    plan, usage, target, point = decision.plan, decision.plan.usage, decision.target, decision.preferred_point
    return DecisionModel(
        status=decision.status,
        instruction=decision.instruction,
        degraded=tuple(
            DegradationModel(stage=d.stage, reason=d.reason, fallback=d.fallback) for d in decision.degraded
        ),
        plan=PlanModel(
            target=plan.target,
            kind=plan.kind,
            role=plan.role,
            mark=plan.mark,
            grid=plan.grid,
            cell=plan.cell,
            crop_xyxy=None if plan.crop_xyxy is None else _box(plan.crop_xyxy),
            objects=tuple(
                PlannedObjectModel(name=o.name, grasp_score=round(float(o.grasp_score), 3), cell=o.cell)
                for o in plan.objects
            ),
            rationale=plan.rationale,
        ),
        target=None if target is None else _target(target, with_mask),
        preferred_point_m=None if point is None else _vector(point if T is None else apply(T, point)),
        grasp=None if decision.grasp is None else _grasp(decision.grasp, T, standoff_m),
        alternatives=tuple(_grasp(g, T, standoff_m) for g in decision.alternatives[:MAX_ALTERNATIVES]),
        funnel=tuple(FunnelModel(check=s.check, n_in=s.n_in, n_out=s.n_out) for s in decision.funnel),
        timings_ms=TimingsModel(**{stage: round(ms, 3) for stage, ms in decision.timings_ms}),
        usage=UsageModel(
            model=usage.model,
            prompt_tokens=usage.prompt_tokens,
            completion_tokens=usage.completion_tokens,
            usd=usage.usd,
            requests=usage.requests,
        ),
        version=__version__,
    )


def decision_json_schema() -> dict[str, object]:
    """Return the JSON Schema of DecisionModel with the published key names."""
    return DecisionModel.model_json_schema(by_alias=True, mode="serialization")


def mask_to_png(mask: Mask) -> str:
    """Encode a mask (H, W) as a 1-bit PNG in base64."""
    buffer = io.BytesIO()
    Image.fromarray(mask).save(buffer, "PNG", optimize=False)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def mask_from_png(text: str) -> Mask:
    """Decode what `mask_to_png` wrote.

    Raises:
        InputError: The text is not base64 or not an image.
    """
    try:
        return np.array(Image.open(io.BytesIO(base64.b64decode(text, validate=True))).convert("1"), np.bool_)
    except (binascii.Error, OSError, ValueError) as error:
        raise InputError(f"mask_png is not a PNG in base64: {error}") from error


def _target(segment: Segment, with_mask: bool) -> TargetModel:
    return TargetModel(
        label=segment.label,
        score=round(float(segment.score), 6),
        box_xyxy=_box(segment.box_xyxy),
        mask_png=mask_to_png(segment.mask) if with_mask else None,
        touches_border=bool(segment.touches_border),
    )


def _grasp(grasp: Grasp, T_world_camera: NDArray[np.float64] | None, standoff_m: float) -> GraspModel:
    R, position, pregrasp = grasp.rotation, grasp.position, grasp.pregrasp(standoff_m)
    if T_world_camera is not None:
        R = T_world_camera[:3, :3] @ R
        position, pregrasp = apply(T_world_camera, position), apply(T_world_camera, pregrasp)
    w, x, y, z = (round(float(q), 9) for q in quat_wxyz(R))
    return GraspModel(
        frame="camera" if T_world_camera is None else "world",
        position_m=_vector(position),
        quat_wxyz=(w, x, y, z),
        rotation=(_vector(R[0], 9), _vector(R[1], 9), _vector(R[2], 9)),
        width_m=round(float(grasp.width_m), 6),
        score=round(float(grasp.score), 6),
        pregrasp_position_m=_vector(pregrasp),
    )


def _vector(v: NDArray[np.floating], digits: int = 6) -> tuple[float, float, float]:
    x, y, z = (round(float(c), digits) for c in v)
    return x, y, z


def _box(box: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = (int(c) for c in box)
    return x0, y0, x1, y1
