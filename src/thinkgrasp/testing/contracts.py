"""The rules of every stage, checked by running a plug-in.

Each function returns None or raises ContractError: what was called, what came back, what the contract allows.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import cast, get_args

import numpy as np

from thinkgrasp import interfaces
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.memory import Memory
from thinkgrasp.testing.rules import (
    Refusal,
    array_rule,
    box_rule,
    has_method,
    mask_rule,
    rotation_rule,
    rule,
    run,
    unless_refused,
)
from thinkgrasp.testing.scenes import empty_scene, sample_frame, sample_scene, strict_scene, top_down_grasps
from thinkgrasp.types import (
    Degradation,
    Frame,
    Grasps,
    Mask,
    Plan,
    PlanKind,
    Proposal,
    Relation,
    Role,
    Scene,
    Segment,
    Segmentation,
)

INSTRUCTIONS = ("the red box", "something to drink from", "the qwertzuiop", "!?")
_GRIPPER = GRIPPERS["robotiq_2f85"]
_TOUCH_M = 0.15
"""A grasp's TCP further than this from every cropped point is not a grasp on them."""


def check_scene(plugin: interfaces.ScenePerception) -> None:
    """Check a scene perception on a full table, a bare one, one with holes in the depth, and without camera pose."""
    has_method(plugin, interfaces.ScenePerception)
    frames = {
        "a table with ten things": sample_frame(),
        "a bare table": sample_frame(things=False),
        "a frame with a fifth of the depth missing": sample_frame(dropout=0.2),
        "a frame without camera pose": sample_frame(pose=False),
    }
    for what, frame in frames.items():
        call = f"perceive({what})"
        scene = run(call, lambda f=frame: plugin.perceive(f), frame, Scene)
        rule(scene.frame is frame, call, "Scene.frame must be the frame that was given")
        _check_scene_arrays(call, scene, frame)
        marks = [p.mark for p in scene.proposals]
        rule(marks == list(range(1, len(marks) + 1)), call, f"marks must be 1..n in order, got {marks}")
        for p in scene.proposals:
            _check_proposal(f"{call} mark {p.mark}", p, frame)
        for edge in scene.obstructions:
            rule(edge.relation in get_args(Relation), call, f"unknown relation {edge.relation!r}")
            rule({edge.a, edge.b} <= set(marks) and edge.a != edge.b, call, f"edge {edge} must join two marks")
            rule(bool(np.isfinite(edge.evidence)) and edge.unit in ("px", "m"), call, f"edge {edge} lacks evidence")


def check_planner(plugin: interfaces.Planner, *, deterministic: bool = True) -> None:
    """Check a planner on scenes with and without proposals; `deterministic=False` for planners that ask a model."""
    has_method(plugin, interfaces.Planner)
    scenes = {"ten things": sample_scene(), "no proposals": empty_scene(), "strict mode": strict_scene()}
    for what, scene in scenes.items():
        for instruction in INSTRUCTIONS:
            call = f"plan({what}, {instruction!r})"
            plan = run(
                call,
                lambda s=scene, i=instruction: plugin.plan(s, i, Memory()),
                scene,
                Plan,
                deterministic=deterministic,
            )
            _check_plan(call, plan, scene)


def check_segmenter(plugin: interfaces.Segmenter) -> None:
    """Check a segmenter with plans for every mark, for text alone, and for something that is not there."""
    has_method(plugin, interfaces.Segmenter)
    full = sample_scene()
    by_mark = [(full, Plan(f"thing {p.mark}", "test", mark=p.mark, crop_xyxy=p.box_xyxy)) for p in full.proposals]
    by_text = [(s, Plan(t, "test")) for s in (full, empty_scene(), strict_scene()) for t in ("red box", "qwertzuiop")]
    for scene, plan in by_mark + by_text:
        call = f"segment({len(scene.proposals)} proposals, target {plan.target!r}, mark {plan.mark})"
        found = run(call, lambda s=scene, p=plan: plugin.segment(s, p), scene, Segmentation)
        _check_degraded(call, found.degraded)
        for s in found.segments:
            _check_segment(call, s, scene)
        scores = [s.score for s in found.segments]
        rule(scores == sorted(scores, reverse=True), call, f"segments must come best first, got scores {scores}")


def check_generator(plugin: interfaces.GraspGenerator) -> None:
    """Check a generator on each thing of a table, on an empty crop, and on a crop without depth."""
    has_method(plugin, interfaces.GraspGenerator)
    full = sample_scene()
    nothing = np.zeros(full.frame.depth.shape, np.bool_)
    blind = ~np.isfinite(full.points[..., 2])
    crops: list[tuple[str, Scene, Mask]] = [(f"mark {p.mark}", full, p.mask) for p in full.proposals]
    crops += [("an empty crop", full, nothing), ("a crop without depth", full, blind)]
    crops += [("strict mode", strict_scene(), full.proposals[0].mask)]
    for what, scene, crop in crops:
        call = f"generate({what})"
        grasps = run(
            call,
            lambda s=scene, c=crop: plugin.generate(s, c, _GRIPPER, np.random.default_rng(0)),
            (scene, crop),
            Grasps,
        )
        seen = scene.points[crop & np.isfinite(scene.points[..., 2])]
        if not len(seen):
            rule(len(grasps) == 0, call, f"nothing can be grasped here, got {len(grasps)} grasps")
            continue
        _check_grasps(call, grasps)
        if len(grasps):
            sample = seen[:: max(1, len(seen) // 500)]
            far = np.linalg.norm(grasps.positions[:, None] - sample[None], axis=2).min(axis=1).max()
            rule(
                float(far) < _TOUCH_M,
                call,
                f"a TCP lies {far:.2f} m from every cropped point; grasps must be in the camera frame, on the crop",
            )


def check_check(plugin: interfaces.Check) -> None:
    """Check a grasp check on many grasps, on none, in strict mode, and without camera pose, which it may refuse."""
    has_method(plugin, interfaces.Check)
    full = sample_scene()
    somewhere = replace(full, frame=sample_frame(pose=False))
    for proposal in full.proposals[:3]:
        target = Segment("thing", 1.0, proposal.mask, proposal.box_xyxy, proposal.touches_border, proposal.mark)
        for what, scene in (("ten things", full), ("strict mode", strict_scene())):
            for grasps in (top_down_grasps(full, proposal), Grasps.empty()):
                call = f"keep({what}, mark {proposal.mark}, {len(grasps)} grasps)"
                keep = run(
                    call,
                    lambda s=scene, t=target, g=grasps: plugin.keep(s, t, g, _GRIPPER),
                    (scene, target, grasps),
                    np.ndarray,
                )
                array_rule(call, "the result", keep, (len(grasps),), np.bool_)
        grasps = top_down_grasps(full, proposal)
        call = f"keep(a frame without camera pose, mark {proposal.mark}, {len(grasps)} grasps)"
        answer = run(
            call,
            lambda t=target, g=grasps: unless_refused(lambda: plugin.keep(somewhere, t, g, _GRIPPER)),
            (somewhere, target, grasps),
            object,
        )
        if not isinstance(answer, Refusal):
            rule(isinstance(answer, np.ndarray), call, f"must return ndarray, got {type(answer).__name__}")
            array_rule(call, "the result", cast(Mask, answer), (len(grasps),), np.bool_)


def _check_scene_arrays(call: str, scene: Scene, frame: Frame) -> None:
    h, w = frame.depth.shape
    array_rule(call, "Scene.points", scene.points, (h, w, 3), np.float32)
    valid = frame.depth > 0
    same = np.isfinite(scene.points[..., 2]) <= valid
    rule(bool(same.all()), call, "Scene.points must be NaN where the depth has no return")
    if scene.normals is not None:
        array_rule(call, "Scene.normals", scene.normals, (h, w, 3), np.float32)
        n = scene.normals[np.isfinite(scene.normals).all(axis=-1)]
        rule(bool(np.allclose(np.linalg.norm(n, axis=-1), 1, atol=1e-2)), call, "Scene.normals must be unit or NaN")
    if scene.region is not None:
        array_rule(call, "Scene.region", scene.region, (h, w), np.bool_)
    if scene.support is not None:
        array_rule(call, "SupportPlane.inliers", scene.support.inliers, (h, w), np.bool_)
        length = float(np.linalg.norm(scene.support.normal))
        rule(abs(length - 1) < 1e-6, call, f"SupportPlane.normal must be unit, has length {length:.6f}")
        above = scene.support.offset_m > 0
        rule(above, call, "SupportPlane.normal must point up: the camera lies above the support")


def _check_proposal(call: str, p: Proposal, frame: Frame) -> None:
    mask_rule(call, "Proposal.mask", p.mask, frame)
    box_rule(call, "Proposal.box_xyxy", p.box_xyxy, p.mask)
    rule(len(p.extents_m) == 3 and min(p.extents_m) > 0, call, f"extents_m must be positive, got {p.extents_m}")
    rule(list(p.extents_m) == sorted(p.extents_m, reverse=True), call, f"longest side first, got {p.extents_m}")
    rotation_rule(call, "T_camera_object", p.T_camera_object[None, :3, :3])
    low, high = p.height_m
    rule(bool(np.isfinite([low, high]).all()) and low <= high, call, f"height_m must be (low, high), got {p.height_m}")
    for name, pairs in (("colors", p.colors), ("shapes", p.shapes)):
        values = [v for _, v in pairs]
        rule(all(-1e-6 <= v <= 1 + 1e-6 for v in values), call, f"{name} must be in 0..1, got {values}")
        rule(values == sorted(values, reverse=True), call, f"{name} must come largest first, got {values}")
    rule(0 <= p.confidence <= 1, call, f"confidence must be in 0..1, got {p.confidence}")


def _check_plan(call: str, plan: Plan, scene: Scene) -> None:
    marks = [p.mark for p in scene.proposals]
    rule(plan.role in get_args(Role), call, f"role must be one of {get_args(Role)}, got {plan.role!r}")
    rule(plan.kind in get_args(PlanKind), call, f"kind must be one of {get_args(PlanKind)}, got {plan.kind!r}")
    rule(plan.mark is None or plan.mark in marks, call, f"mark {plan.mark} is not in this scene ({marks})")
    rule(bool(plan.rationale.strip()), call, "rationale must say why")
    rule(not plan.found or bool(plan.target.strip()), call, "target must name what to take")
    if plan.crop_xyxy is not None:
        x0, y0, x1, y1 = plan.crop_xyxy
        h, w = scene.frame.depth.shape
        rule(0 <= x0 < x1 <= w and 0 <= y0 < y1 <= h, call, f"crop_xyxy {plan.crop_xyxy} is not inside {w}x{h}")
    for o in plan.objects:
        rule(0 <= o.grasp_score <= 100, call, f"grasp_score must be in 0..100, got {o}")
        rule(o.cell is None or 1 <= o.cell <= plan.grid**2, call, f"cell must be in 1..{plan.grid**2}, got {o}")
    _check_degraded(call, plan.degraded)


def _check_segment(call: str, s: Segment, scene: Scene) -> None:
    mask_rule(call, "Segment.mask", s.mask, scene.frame)
    box_rule(call, "Segment.box_xyxy", s.box_xyxy, s.mask)
    rule(bool(s.label.strip()), call, "Segment.label must not be empty")
    rule(bool(np.isfinite(s.score)), call, f"Segment.score must be finite, got {s.score}")
    marks = [p.mark for p in scene.proposals]
    rule(s.mark is None or s.mark in marks, call, f"Segment.mark {s.mark} is not in this scene ({marks})")


def _check_grasps(call: str, grasps: Grasps) -> None:
    for field in fields(grasps):
        values = getattr(grasps, field.name)
        rule(bool(np.isfinite(values).all()), call, f"Grasps.{field.name} must be finite")
    rotation_rule(call, "Grasps.rotations", grasps.rotations)
    for name, values, high in (("scores", grasps.scores, 1.0), ("widths", grasps.widths, 1.0)):
        ok = bool(((values >= 0) & (values <= high)).all())
        rule(ok, call, f"Grasps.{name} must be in 0..{high:g}")


def _check_degraded(call: str, degraded: tuple[Degradation, ...]) -> None:
    for d in degraded:
        rule(bool(d.stage and d.reason and d.fallback), call, f"{d} must name stage, reason and fallback")
