"""The rules of every interface, checked by running a plug-in.

Each function returns None or raises ContractError: what was called, what came back, what the contract allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TypeVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

from thinkgrasp import interfaces
from thinkgrasp.errors import ConfigError, ContractError, InputError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.memory import Memory
from thinkgrasp.testing.scenes import empty_scene, sample_frame, sample_scene, strict_scene
from thinkgrasp.types import (
    Decision,
    Degradation,
    Frame,
    Grasps,
    Mask,
    Outcome,
    Plan,
    PlanKind,
    Proposal,
    Relation,
    Role,
    Scene,
    Segment,
    Segmentation,
)

T = TypeVar("T")
INSTRUCTIONS = ("the red box", "something to drink from", "the qwertzuiop", "!?")
_GRIPPER = GRIPPERS["robotiq_2f85"]
_TOUCH_M = 0.15
"""A grasp's TCP further than this from every cropped point is not a grasp on them."""


def check_scene(plugin: interfaces.ScenePerception) -> None:
    """Check a scene perception on a full table, a bare one, one with holes in the depth, and without camera pose."""
    _has(plugin, interfaces.ScenePerception)
    frames = {
        "a table with ten things": sample_frame(),
        "a bare table": sample_frame(things=False),
        "a frame with a fifth of the depth missing": sample_frame(dropout=0.2),
        "a frame without camera pose": sample_frame(pose=False),
    }
    for what, frame in frames.items():
        call = f"perceive({what})"
        scene = _run(call, lambda f=frame: plugin.perceive(f), frame, Scene)
        _rule(scene.frame is frame, call, "Scene.frame must be the frame that was given")
        _check_scene_arrays(call, scene, frame)
        marks = [p.mark for p in scene.proposals]
        _rule(marks == list(range(1, len(marks) + 1)), call, f"marks must be 1..n in order, got {marks}")
        for p in scene.proposals:
            _check_proposal(f"{call} mark {p.mark}", p, frame)
        for edge in scene.obstructions:
            _rule(edge.relation in get_args(Relation), call, f"unknown relation {edge.relation!r}")
            _rule({edge.a, edge.b} <= set(marks) and edge.a != edge.b, call, f"edge {edge} must join two marks")
            _rule(bool(np.isfinite(edge.evidence)) and edge.unit in ("px", "m"), call, f"edge {edge} lacks evidence")


def check_planner(plugin: interfaces.Planner, *, deterministic: bool = True) -> None:
    """Check a planner on scenes with and without proposals; `deterministic=False` for planners that ask a model."""
    _has(plugin, interfaces.Planner)
    scenes = {"ten things": sample_scene(), "no proposals": empty_scene(), "strict mode": strict_scene()}
    for what, scene in scenes.items():
        for instruction in INSTRUCTIONS:
            call = f"plan({what}, {instruction!r})"
            plan = _run(
                call,
                lambda s=scene, i=instruction: plugin.plan(s, i, Memory()),
                scene,
                Plan,
                deterministic=deterministic,
            )
            _check_plan(call, plan, scene)


def check_segmenter(plugin: interfaces.Segmenter) -> None:
    """Check a segmenter with plans for every mark, for text alone, and for something that is not there."""
    _has(plugin, interfaces.Segmenter)
    full = sample_scene()
    by_mark = [(full, Plan(f"thing {p.mark}", "test", mark=p.mark, crop_xyxy=p.box_xyxy)) for p in full.proposals]
    by_text = [(s, Plan(t, "test")) for s in (full, empty_scene(), strict_scene()) for t in ("red box", "qwertzuiop")]
    for scene, plan in by_mark + by_text:
        call = f"segment({len(scene.proposals)} proposals, target {plan.target!r}, mark {plan.mark})"
        found = _run(call, lambda s=scene, p=plan: plugin.segment(s, p), scene, Segmentation)
        _check_degraded(call, found.degraded)
        for s in found.segments:
            _check_segment(call, s, scene)
        scores = [s.score for s in found.segments]
        _rule(scores == sorted(scores, reverse=True), call, f"segments must come best first, got scores {scores}")


def check_generator(plugin: interfaces.GraspGenerator) -> None:
    """Check a generator on each thing of a table, on an empty crop, and on a crop without depth."""
    _has(plugin, interfaces.GraspGenerator)
    full = sample_scene()
    nothing = np.zeros(full.frame.depth.shape, np.bool_)
    blind = ~np.isfinite(full.points[..., 2])
    crops: list[tuple[str, Scene, Mask]] = [(f"mark {p.mark}", full, p.mask) for p in full.proposals]
    crops += [("an empty crop", full, nothing), ("a crop without depth", full, blind)]
    crops += [("strict mode", strict_scene(), full.proposals[0].mask)]
    for what, scene, crop in crops:
        call = f"generate({what})"
        grasps = _run(
            call,
            lambda s=scene, c=crop: plugin.generate(s, c, _GRIPPER, np.random.default_rng(0)),
            (scene, crop),
            Grasps,
        )
        seen = scene.points[crop & np.isfinite(scene.points[..., 2])]
        if not len(seen):
            _rule(len(grasps) == 0, call, f"nothing can be grasped here, got {len(grasps)} grasps")
            continue
        _check_grasps(call, grasps)
        if len(grasps):
            sample = seen[:: max(1, len(seen) // 500)]
            far = np.linalg.norm(grasps.positions[:, None] - sample[None], axis=2).min(axis=1).max()
            _rule(
                float(far) < _TOUCH_M,
                call,
                f"a TCP lies {far:.2f} m from every cropped point; grasps must be in the camera frame, on the crop",
            )


def check_check(plugin: interfaces.Check) -> None:
    """Check a grasp check on many grasps, on none, in strict mode, and without camera pose, which it may refuse."""
    _has(plugin, interfaces.Check)
    full = sample_scene()
    somewhere = replace(full, frame=sample_frame(pose=False))
    for proposal in full.proposals[:3]:
        target = Segment("thing", 1.0, proposal.mask, proposal.box_xyxy, proposal.touches_border, proposal.mark)
        for what, scene in (("ten things", full), ("strict mode", strict_scene())):
            for grasps in (_top_down_grasps(full, proposal), Grasps.empty()):
                call = f"keep({what}, mark {proposal.mark}, {len(grasps)} grasps)"
                keep = _run(
                    call,
                    lambda s=scene, t=target, g=grasps: plugin.keep(s, t, g, _GRIPPER),
                    (scene, target, grasps),
                    np.ndarray,
                )
                _array(call, "the result", keep, (len(grasps),), np.bool_)
        grasps = _top_down_grasps(full, proposal)
        call = f"keep(a frame without camera pose, mark {proposal.mark}, {len(grasps)} grasps)"
        answer = _run(
            call,
            lambda t=target, g=grasps: _unless_refused(lambda: plugin.keep(somewhere, t, g, _GRIPPER)),
            (somewhere, target, grasps),
            object,
        )
        if not isinstance(answer, _Refusal):
            _rule(isinstance(answer, np.ndarray), call, f"must return ndarray, got {type(answer).__name__}")
            _array(call, "the result", cast(Mask, answer), (len(grasps),), np.bool_)


def check_camera(plugin: interfaces.Camera) -> None:
    """Check that a camera gives frames, again and again. Frame checks sizes and types itself."""
    _has(plugin, interfaces.Camera)
    frames = [_guard("read()", plugin.read) for _ in range(2)]
    for frame in frames:
        _rule(isinstance(frame, Frame), "read()", f"must return Frame, got {type(frame).__name__}")
        _rule(bool((frame.depth > 0).any()), "read()", "the depth holds no return at all")
    _rule(frames[0].camera == frames[1].camera, "read()", "the intrinsics changed between two frames")


def check_robot(plugin: interfaces.Robot) -> None:
    """Check a robot by grasps on a table top, from below it and far away, and by a frame without camera pose.

    It MOVES: give it a simulated or disconnected arm. Only the missing pose may be refused; what a grasp came to is
    always told by an outcome.
    """
    _has(plugin, interfaces.Robot)
    scene = sample_scene()
    grasp = _top_down_grasps(scene, scene.proposals[0]).at(0)
    grasps = {
        "a top-down grasp": grasp,
        "a grasp from under the table": replace(grasp, rotation=grasp.rotation @ np.diag([1.0, -1.0, -1.0])),
        "a grasp 5 m away": replace(grasp, position=grasp.position + np.array([0.0, 0.0, 5.0])),
    }
    for what, g in grasps.items():
        call = f"execute({what})"
        outcome = _run(call, lambda g=g: plugin.execute(g, scene.frame), (g, scene), Outcome, deterministic=False)
        _check_outcome(call, outcome)
    call, frame = "execute(a frame without camera pose)", sample_frame(pose=False)
    answer = _run(
        call,
        lambda: _unless_refused(lambda: plugin.execute(grasp, frame)),
        (grasp, frame),
        object,
        deterministic=False,
    )
    if not isinstance(answer, _Refusal):
        _rule(isinstance(answer, Outcome), call, f"must return Outcome, got {type(answer).__name__}")
        _check_outcome(call, cast(Outcome, answer))


def check_recorder(plugin: interfaces.Recorder) -> None:
    """Check that a recorder takes decisions with and without grasp and outcome."""
    _has(plugin, interfaces.Recorder)
    scene = sample_scene()
    nothing = Decision("no_target", "the kettle", scene, Plan("kettle", "none in view", found=False))
    grasp = _top_down_grasps(scene, scene.proposals[0]).at(0)
    full = Decision("grasp", "a thing", scene, Plan("thing", "test", mark=1), grasp=grasp)
    for decision, outcome in ((nothing, None), (full, None), (full, Outcome(True, "held"))):
        call = f"record({decision.status}, {outcome})"
        result = _guard(call, lambda d=decision, o=outcome: cast(object, plugin.record(d, o)))
        _rule(result is None, call, f"must return None, got {type(result).__name__}")


def _check_scene_arrays(call: str, scene: Scene, frame: Frame) -> None:
    h, w = frame.depth.shape
    _array(call, "Scene.points", scene.points, (h, w, 3), np.float32)
    valid = frame.depth > 0
    same = np.isfinite(scene.points[..., 2]) <= valid
    _rule(bool(same.all()), call, "Scene.points must be NaN where the depth has no return")
    if scene.normals is not None:
        _array(call, "Scene.normals", scene.normals, (h, w, 3), np.float32)
        n = scene.normals[np.isfinite(scene.normals).all(axis=-1)]
        _rule(bool(np.allclose(np.linalg.norm(n, axis=-1), 1, atol=1e-2)), call, "Scene.normals must be unit or NaN")
    if scene.region is not None:
        _array(call, "Scene.region", scene.region, (h, w), np.bool_)
    if scene.support is not None:
        _array(call, "SupportPlane.inliers", scene.support.inliers, (h, w), np.bool_)
        length = float(np.linalg.norm(scene.support.normal))
        _rule(abs(length - 1) < 1e-6, call, f"SupportPlane.normal must be unit, has length {length:.6f}")
        above = scene.support.offset_m > 0
        _rule(above, call, "SupportPlane.normal must point up: the camera lies above the support")


def _check_proposal(call: str, p: Proposal, frame: Frame) -> None:
    _mask(call, "Proposal.mask", p.mask, frame)
    _box(call, "Proposal.box_xyxy", p.box_xyxy, p.mask)
    _rule(len(p.extents_m) == 3 and min(p.extents_m) > 0, call, f"extents_m must be positive, got {p.extents_m}")
    _rule(list(p.extents_m) == sorted(p.extents_m, reverse=True), call, f"longest side first, got {p.extents_m}")
    _rotation(call, "T_camera_object", p.T_camera_object[None, :3, :3])
    low, high = p.height_m
    _rule(bool(np.isfinite([low, high]).all()) and low <= high, call, f"height_m must be (low, high), got {p.height_m}")
    for name, pairs in (("colors", p.colors), ("shapes", p.shapes)):
        values = [v for _, v in pairs]
        _rule(all(-1e-6 <= v <= 1 + 1e-6 for v in values), call, f"{name} must be in 0..1, got {values}")
        _rule(values == sorted(values, reverse=True), call, f"{name} must come largest first, got {values}")
    _rule(0 <= p.confidence <= 1, call, f"confidence must be in 0..1, got {p.confidence}")


def _check_plan(call: str, plan: Plan, scene: Scene) -> None:
    marks = [p.mark for p in scene.proposals]
    _rule(plan.role in get_args(Role), call, f"role must be one of {get_args(Role)}, got {plan.role!r}")
    _rule(plan.kind in get_args(PlanKind), call, f"kind must be one of {get_args(PlanKind)}, got {plan.kind!r}")
    _rule(plan.mark is None or plan.mark in marks, call, f"mark {plan.mark} is not in this scene ({marks})")
    _rule(bool(plan.rationale.strip()), call, "rationale must say why")
    _rule(not plan.found or bool(plan.target.strip()), call, "target must name what to take")
    if plan.crop_xyxy is not None:
        x0, y0, x1, y1 = plan.crop_xyxy
        h, w = scene.frame.depth.shape
        _rule(0 <= x0 < x1 <= w and 0 <= y0 < y1 <= h, call, f"crop_xyxy {plan.crop_xyxy} is not inside {w}x{h}")
    for o in plan.objects:
        _rule(0 <= o.grasp_score <= 100, call, f"grasp_score must be in 0..100, got {o}")
        _rule(o.cell is None or 1 <= o.cell <= plan.grid**2, call, f"cell must be in 1..{plan.grid**2}, got {o}")
    _check_degraded(call, plan.degraded)


def _check_segment(call: str, s: Segment, scene: Scene) -> None:
    _mask(call, "Segment.mask", s.mask, scene.frame)
    _box(call, "Segment.box_xyxy", s.box_xyxy, s.mask)
    _rule(bool(s.label.strip()), call, "Segment.label must not be empty")
    _rule(bool(np.isfinite(s.score)), call, f"Segment.score must be finite, got {s.score}")
    marks = [p.mark for p in scene.proposals]
    _rule(s.mark is None or s.mark in marks, call, f"Segment.mark {s.mark} is not in this scene ({marks})")


def _check_grasps(call: str, grasps: Grasps) -> None:
    for field in fields(grasps):
        values = getattr(grasps, field.name)
        _rule(bool(np.isfinite(values).all()), call, f"Grasps.{field.name} must be finite")
    _rotation(call, "Grasps.rotations", grasps.rotations)
    for name, values, high in (("scores", grasps.scores, 1.0), ("widths", grasps.widths, 1.0)):
        ok = bool(((values >= 0) & (values <= high)).all())
        _rule(ok, call, f"Grasps.{name} must be in 0..{high:g}")


def _check_outcome(call: str, outcome: Outcome) -> None:
    _rule(isinstance(outcome.success, bool), call, f"success must be bool, got {type(outcome.success).__name__}")
    reason = outcome.reason
    named = isinstance(reason, str) and reason.isidentifier() and reason.islower()
    _rule(named, call, f"reason must name what became of the grasp, as 'held' or 'missed', got {reason!r}")
    _rule(outcome.success == (reason == "held"), call, f"success is told as 'held' and nothing else is, got {outcome}")


def _check_degraded(call: str, degraded: tuple[Degradation, ...]) -> None:
    for d in degraded:
        _rule(bool(d.stage and d.reason and d.fallback), call, f"{d} must name stage, reason and fallback")


def _top_down_grasps(scene: Scene, proposal: Proposal, n: int = 24) -> Grasps:
    points = scene.points[proposal.mask & np.isfinite(scene.points[..., 2])]
    rng = np.random.default_rng(0)
    assert scene.support is not None  # sample_scene always has one
    z = -scene.support.normal
    rotations: list[NDArray[np.float64]] = []
    for angle in rng.uniform(0, np.pi, n):
        side = np.cross(z, [1.0, 0.0, 0.0])
        x = side / np.linalg.norm(side)
        x = float(np.cos(angle)) * x + float(np.sin(angle)) * np.cross(z, x)
        rotations.append(np.stack([x, np.cross(z, x), z], axis=1))
    return Grasps(
        np.array(rotations, np.float32),
        points[rng.integers(0, len(points), n)],
        rng.uniform(0.01, 0.12, n).astype(np.float32),
        rng.uniform(0, 1, n).astype(np.float32),
    )


def _has(plugin: object, protocol: type) -> None:
    if not isinstance(plugin, protocol):
        methods = [m for m in vars(protocol) if not m.startswith("_")]
        raise ContractError(f"{type(plugin).__name__} lacks the method {', '.join(methods)} of {protocol.__name__}")


def _rule(holds: bool, call: str, message: str) -> None:
    if not holds:
        raise ContractError(f"{call}: {message}")


def _guard(call: str, function: Callable[[], T]) -> T:
    try:
        return function()
    except Exception as error:
        raise ContractError(
            f"{call} raised {type(error).__name__}: {error}; expected outcomes are values, not exceptions"
        ) from error


def _run(call: str, function: Callable[[], T], given: object, kind: type[T], *, deterministic: bool = True) -> T:
    """Call twice; the results must be of `kind` and equal, and what was given must be as before."""
    before = _arrays(given)
    copies = [a.copy() for a in before]
    result = _guard(call, function)
    _rule(isinstance(result, kind), call, f"must return {kind.__name__}, got {type(result).__name__}")
    for array, copy in zip(before, copies, strict=True):
        same = np.array_equal(array, copy, equal_nan=array.dtype.kind == "f")
        _rule(same, call, f"an input array {array.shape} {array.dtype} was changed; work on a copy")
    if deterministic:
        _rule(_equal(result, _guard(call, function)), call, "the same input gave another result the second time")
    return result


@dataclass(frozen=True)
class _Refusal:
    """A plug-in's word that it cannot do without what is missing."""

    message: str


def _unless_refused(function: Callable[[], object]) -> object:
    try:
        return function()
    except (ConfigError, InputError) as error:
        return _Refusal(str(error))


def _arrays(value: object) -> list[NDArray[np.generic]]:
    if isinstance(value, np.ndarray):
        return [cast(NDArray[np.generic], value)]
    if isinstance(value, tuple):
        return [a for item in cast(tuple[object, ...], value) for a in _arrays(item)]
    if is_dataclass(value):
        return [a for f in fields(value) for a in _arrays(getattr(value, f.name))]
    return []


def _equal(a: object, b: object) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        x, y = cast(NDArray[np.generic], a), cast(NDArray[np.generic], b)
        return x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f")
    if isinstance(a, tuple) and isinstance(b, tuple):
        xs, ys = cast(tuple[object, ...], a), cast(tuple[object, ...], b)
        return len(xs) == len(ys) and all(_equal(x, y) for x, y in zip(xs, ys, strict=True))
    if is_dataclass(a):
        return all(_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b or (a != a and b != b)  # NaN equals NaN here


def _array(call: str, name: str, array: NDArray[np.generic], shape: tuple[int, ...], dtype: type) -> None:
    ok = array.shape == shape and array.dtype == dtype
    _rule(ok, call, f"{name} must be {shape} {np.dtype(dtype)}, got {array.shape} {array.dtype}")


def _mask(call: str, name: str, mask: Mask, frame: Frame) -> None:
    _array(call, name, mask, frame.depth.shape, np.bool_)
    _rule(bool(mask.any()), call, f"{name} must not be empty")


def _box(call: str, name: str, box: tuple[int, int, int, int], mask: Mask) -> None:
    v, u = np.nonzero(mask)
    tight = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
    _rule(tuple(box) == tight, call, f"{name} must be the mask's half-open box {tight}, got {tuple(box)}")


def _rotation(call: str, name: str, rotations: NDArray[np.floating]) -> None:
    R = rotations.astype(np.float64)
    proper = np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-3) and bool((np.linalg.det(R) > 0).all())
    _rule(proper, call, f"{name} must be proper rotations (orthonormal, determinant +1)")
