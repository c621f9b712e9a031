"""The data that flows through the stages: frozen dataclasses, checked when they are made.

Everything spatial is in the camera's optical frame (x right, y down, z forward) and in metres unless a name says
otherwise. Arrays are not copied; treat them as read-only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ContractError, InputError

Array = NDArray[np.float32]
"""Float32 array; the field's comment gives shape and unit."""
Mask = NDArray[np.bool_]
"""Boolean image of shape (H, W)."""
BoxXYXY = tuple[int, int, int, int]
"""Half-open pixel box (x0, y0, x1, y1): columns x0..x1-1, rows y0..y1-1."""

Role = Literal["goal", "obstruction"]
PlanKind = Literal["object", "part"]
Relation = Literal["hides", "rests_on", "blocks"]


@dataclass(frozen=True)
class CameraIntrinsics:
    """Pinhole camera without distortion; pixel centres at integers.

    Raises:
        InputError: A size or focal length is not positive and finite, or the principal point is outside the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0):
            raise InputError(f"camera size must be positive, got {self.width}x{self.height}")
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"camera focal length {name} must be positive [px], got {value}")
        for name, size in (("cx", self.width), ("cy", self.height)):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 <= value <= size - 1):
                raise InputError(
                    f"camera principal point {name}={value} lies outside the image (allowed 0..{size - 1}); "
                    "check that the intrinsics belong to this image size"
                )

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project points (..., 3) [m] in front of the camera to pixels (..., 2) as (u, v)."""
        points = np.asarray(points, np.float64)
        z = points[..., 2]
        return np.stack([points[..., 0] / z * self.fx + self.cx, points[..., 1] / z * self.fy + self.cy], axis=-1)


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D view.

    Raises:
        InputError: Colour and depth differ in size, are not the camera's size, or have another type.
    """

    color: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    depth: Array
    """(H, W) [m] along the optical axis; 0 or NaN = no return."""
    camera: CameraIntrinsics
    T_world_camera: NDArray[np.float64] | None = None
    """(4, 4) camera to world; None = unknown."""
    workspace: Mask | None = None
    """(H, W) where grasping is allowed; None = everywhere."""
    others: OtherViews | None = None
    """What other cameras saw beyond this view; None = this view alone. `thinkgrasp.fusion.fuse` fills it in."""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.dtype != np.uint8 or self.color.ndim != 3 or self.color.shape[2] != 3:
            raise InputError(f"colour must be (H, W, 3) uint8, got {self.color.shape} {self.color.dtype}")
        if self.depth.dtype != np.float32 or self.depth.ndim != 2:
            raise InputError(f"depth must be (H, W) float32 metres, got {self.depth.shape} {self.depth.dtype}")
        if self.color.shape[:2] != self.depth.shape:
            raise InputError(f"colour is {_wh(self.color)} but depth is {_wh(self.depth)}; align depth to colour first")
        if self.depth.shape != size:
            raise InputError(f"the images are {_wh(self.depth)} but the camera is {size[1]}x{size[0]}")
        if self.workspace is not None and (self.workspace.shape != size or self.workspace.dtype != np.bool_):
            raise InputError(
                f"workspace mask must be {size[1]}x{size[0]} boolean, got {_wh(self.workspace)} {self.workspace.dtype}"
            )
        if self.T_world_camera is not None:
            _check_transform("T_world_camera", self.T_world_camera)


@dataclass(frozen=True, eq=False)
class OtherViews:
    """What other cameras saw of the same things and one camera did not, in that one camera's frame.

    Raises:
        ContractError: The arrays disagree in length or have another shape.
    """

    frames: tuple[Frame, ...]
    """As they were taken; their poses are known."""
    points: Array
    """(M, 3) [m], thinned."""
    normals: Array
    """(M, 3) unit, towards the camera that saw the point; NaN where unknown."""
    colors: NDArray[np.uint8]
    """(M, 3) RGB."""
    view: NDArray[np.uint8]
    """(M,) which of `frames` saw it."""
    disagreement_m: tuple[float, ...]
    """By how much the surfaces that each of `frames` shares with the one camera lie apart; NaN = none is shared."""
    agrees: tuple[bool, ...]
    """Whether each of `frames` fits the one camera's view; grasps are proposed on the points of those alone."""
    degraded: tuple[Degradation, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.points)
        for name, shape in (("points", (n, 3)), ("normals", (n, 3)), ("colors", (n, 3)), ("view", (n,))):
            if getattr(self, name).shape != shape:
                raise ContractError(f"OtherViews.{name} must be {shape}, got {getattr(self, name).shape}")
        sizes = {len(self.frames), len(self.disagreement_m), len(self.agrees)}
        if len(sizes) > 1 or (n and int(self.view.max()) >= len(self.frames)):
            raise ContractError(f"OtherViews holds {len(self.frames)} frames, but its fields speak of others")

    def agreeing(self) -> NDArray[np.bool_]:
        """Return (M,) True for the points of frames that agree."""
        return np.array(self.agrees, np.bool_)[self.view]


def _wh(image: NDArray[np.generic]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}" if image.ndim >= 2 else str(image.shape)


def _check_transform(name: str, T: NDArray[np.float64]) -> None:
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{name} must be a finite 4x4 matrix, got shape {T.shape}")
    R = T[:3, :3]
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], [0, 0, 0, 1])):
        raise InputError(f"{name} must be a rigid transform (rotation + translation, last row 0 0 0 1)")


@dataclass(frozen=True, eq=False)
class SupportPlane:
    """The surface things stand on: points p with normal . p + offset_m = 0."""

    normal: NDArray[np.float64]
    """(3,) unit, pointing up, away from the support and towards the camera's side."""
    offset_m: float
    inliers: Mask
    """(H, W) pixels seen to lie on it."""
    residual_m: float
    """Median absolute distance of the inliers."""

    def height(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Height of points (..., 3) above the support, (...) [m]."""
        return points @ self.normal.astype(points.dtype) + points.dtype.type(self.offset_m)

    def resized(self, scale: int, shape: tuple[int, ...]) -> SupportPlane:
        """Return a copy whose inlier mask is enlarged by a whole factor and cut to an image's shape (H, W)."""
        inliers = self.inliers.repeat(scale, axis=0).repeat(scale, axis=1)[: shape[0], : shape[1]]
        return replace(self, inliers=inliers)


@dataclass(frozen=True, eq=False)
class Proposal:
    """One thing that perception believes to be an object."""

    mark: int
    """1-based number drawn on the image and used in plans."""
    mask: Mask
    """(H, W) visible pixels."""
    box_xyxy: BoxXYXY
    extents_m: tuple[float, float, float]
    """Sides of the oriented box around the visible and inferred volume, longest first."""
    T_camera_object: NDArray[np.float64]
    """(4, 4) centre and axes of that box; axis i belongs to extents_m[i]."""
    height_m: tuple[float, float]
    """Lowest and highest point above the support."""
    colors: tuple[tuple[str, float], ...]
    """Colour names with the share of pixels, largest first; the names are those of thinkgrasp.language."""
    shapes: tuple[tuple[str, float], ...]
    """Descriptors (round, cylindrical, box-like, flat, elongated, hollow) with a degree 0..1, largest first."""
    touches_border: bool
    confidence: float
    """0..1 that this is one whole object."""

    @property
    def center_m(self) -> NDArray[np.float64]:
        """(3,) centre of the oriented box."""
        return self.T_camera_object[:3, 3]

    def color_share(self, name: str) -> float:
        """Share of the pixels that carry this colour name, 0..1."""
        return dict(self.colors).get(name, 0.0)

    def shape_degree(self, name: str) -> float:
        """Degree 0..1 of this shape descriptor."""
        return dict(self.shapes).get(name, 0.0)


@dataclass(frozen=True)
class Obstruction:
    """One edge of the obstruction graph: `a` hides, rests on, or blocks the gripper's way to `b` (marks)."""

    relation: Relation
    a: int
    b: int
    evidence: float
    unit: Literal["px", "m"]


@dataclass(frozen=True, eq=False)
class Scene:
    """What perception knows about one frame. In strict mode only `frame` and `points` are filled."""

    frame: Frame
    points: Array
    """(H, W, 3) [m] camera frame; NaN = no return."""
    normals: Array | None = None
    """(H, W, 3) unit, towards the camera; NaN where unknown."""
    support: SupportPlane | None = None
    region: Mask | None = None
    """(H, W) above the support and inside the workspace."""
    proposals: tuple[Proposal, ...] = ()
    obstructions: tuple[Obstruction, ...] = ()
    degraded: tuple[Degradation, ...] = ()

    def proposal(self, mark: int) -> Proposal:
        """Return the proposal with this mark, or raise ContractError naming the marks that exist."""
        for proposal in self.proposals:
            if proposal.mark == mark:
                return proposal
        raise ContractError(f"no proposal has mark {mark}; marks in this scene: {[p.mark for p in self.proposals]}")

    def cloud(self) -> Array:
        """Return everything that was seen, (N, 3) [m]: finite points of this view, and what other cameras saw."""
        flat = self.points.reshape(-1, 3)
        seen = flat[np.isfinite(flat[:, 2])]
        others = self.frame.others
        return seen if others is None else np.concatenate([seen, others.points])

    def obstructing(self, mark: int) -> tuple[Obstruction, ...]:
        """Edges whose `b` is this mark: what is in its way, including what rests on it."""
        return tuple(e for e in self.obstructions if e.b == mark)


@dataclass(frozen=True)
class Degradation:
    """One fallback that was taken, and why."""

    stage: str
    reason: str
    fallback: str


@dataclass(frozen=True)
class Usage:
    """What a planner spent."""

    model: str | None = None
    prompt_tokens: int = 0
    completion_tokens: int = 0
    usd: float | None = None
    """None = not known; a planner that asked no model spent nothing, whatever stands here."""
    requests: int = 0
    latency_s: float = 0.0
    """Time from the first request to the last reply, waits between them included."""

    def __add__(self, other: Usage) -> Usage:
        asked = [usage for usage in (self, other) if usage.requests]
        known = [usage.usd for usage in asked if usage.usd is not None]
        return Usage(
            next((usage.model for usage in reversed(asked)), None),
            self.prompt_tokens + other.prompt_tokens,
            self.completion_tokens + other.completion_tokens,
            sum(known) if known and len(known) == len(asked) else None,
            self.requests + other.requests,
            self.latency_s + other.latency_s,
        )


@dataclass(frozen=True)
class PlannedObject:
    """One object a planner considered, with its opinion of how well it can be grasped (0..100)."""

    name: str
    grasp_score: float
    cell: int | None = None


@dataclass(frozen=True)
class Plan:
    """What to take now, where, and why. `found` is False when nothing in view is worth taking."""

    target: str
    rationale: str
    role: Role = "goal"
    kind: PlanKind = "object"
    mark: int | None = None
    grid: int = 3
    cell: int = 5
    crop_xyxy: BoxXYXY | None = None
    objects: tuple[PlannedObject, ...] = ()
    point_px: tuple[int, int] | None = None
    """Pixel (u, v) that the fingers are to close on; None = the middle of the cell."""
    found: bool = True
    out_of_budget: bool = False
    """The planner may spend no more, so that the episode ends; the plan is not `found` then."""
    degraded: tuple[Degradation, ...] = ()
    usage: Usage = field(default_factory=Usage)

    def __post_init__(self) -> None:
        if self.grid < 1 or not 1 <= self.cell <= self.grid**2:
            raise ContractError(f"plan cell {self.cell} is outside 1..{self.grid**2} of a {self.grid}x{self.grid} grid")


@dataclass(frozen=True, eq=False)
class Segment:
    """One mask that answers to the plan's text."""

    label: str
    score: float
    mask: Mask
    box_xyxy: BoxXYXY
    touches_border: bool
    mark: int | None = None


@dataclass(frozen=True)
class Segmentation:
    """All segments that answer to the plan, best first, and what fell back."""

    segments: tuple[Segment, ...]
    degraded: tuple[Degradation, ...] = ()


@dataclass(frozen=True, eq=False)
class Grasps:
    """A batch of two-finger grasps in the camera frame; +z approach, +x closing, origin = TCP between the fingertips.

    Raises:
        ContractError: The arrays disagree in length or have another shape.
    """

    rotations: Array
    """(N, 3, 3) columns: closing, binormal, approach."""
    positions: Array
    """(N, 3) TCP [m]."""
    widths: Array
    """(N,) opening before closing [m]."""
    scores: Array
    """(N,) 0..1, higher is better."""

    def __post_init__(self) -> None:
        n = len(self.positions)
        for name, shape in (("rotations", (n, 3, 3)), ("positions", (n, 3)), ("widths", (n,)), ("scores", (n,))):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise ContractError(f"Grasps.{name} must be {shape} float32, got {array.shape} {array.dtype}")

    @classmethod
    def empty(cls) -> Grasps:
        """Return a batch of none."""
        z = np.zeros
        return cls(z((0, 3, 3), np.float32), z((0, 3), np.float32), z(0, np.float32), z(0, np.float32))

    @classmethod
    def concatenate(cls, parts: Iterable[Grasps]) -> Grasps:
        """Join batches, best first; of equal scores the earlier comes first."""
        batches = [cls.empty(), *parts]
        names = ("rotations", "positions", "widths", "scores")
        joined = cls(*(np.concatenate([getattr(b, name) for b in batches]) for name in names))
        return joined[np.argsort(-joined.scores, kind="stable")]

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Grasps:
        return Grasps(self.rotations[index], self.positions[index], self.widths[index], self.scores[index])

    def __iter__(self) -> Iterator[Grasp]:
        return (self.at(i) for i in range(len(self)))

    def at(self, index: int) -> Grasp:
        """Return one grasp of the batch."""
        return Grasp(
            self.rotations[index].astype(np.float64),
            self.positions[index].astype(np.float64),
            float(self.widths[index]),
            float(self.scores[index]),
        )


@dataclass(frozen=True, eq=False)
class Grasp:
    """One two-finger grasp in the camera frame; axes as in Grasps."""

    rotation: NDArray[np.float64]
    """(3, 3) columns: closing, binormal, approach."""
    position: NDArray[np.float64]
    """(3,) TCP [m]."""
    width_m: float
    score: float

    def pregrasp(self, standoff_m: float) -> NDArray[np.float64]:
        """Return the TCP position (3,) [m] that lies `standoff_m` back along the approach."""
        return self.position - standoff_m * self.rotation[:, 2]


@dataclass(frozen=True)
class FunnelStep:
    """How many grasps went into a check and how many came out."""

    check: str
    n_in: int
    n_out: int


Status = Literal["grasp", "no_target", "no_grasp"]


@dataclass(frozen=True, eq=False)
class Decision:
    """The answer to one frame and one sentence, with everything needed to explain it."""

    status: Status
    instruction: str
    scene: Scene
    plan: Plan
    target: Segment | None = None
    crop: Mask | None = None
    """(H, W) union of all segments, what the generator was given."""
    preferred_point: NDArray[np.float64] | None = None
    """(3,) [m] camera frame."""
    grasp: Grasp | None = None
    alternatives: tuple[Grasp, ...] = ()
    funnel: tuple[FunnelStep, ...] = ()
    degraded: tuple[Degradation, ...] = ()
    timings_ms: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What a robot reports after trying a grasp."""

    success: bool
    reason: str
    """Named reason: "held", "missed", "slipped", "unreachable", "collision"; of a real robot also those of
    `thinkgrasp.lab.safety.Reason`."""
