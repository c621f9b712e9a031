"""One frame and one sentence in, one Decision out. Knows no robot and no plug-in by name."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from thinkgrasp.errors import ContractError, InputError
from thinkgrasp.geometry import deproject
from thinkgrasp.gripper import Gripper
from thinkgrasp.interfaces import Check, GraspGenerator, Planner, ScenePerception, Segmenter
from thinkgrasp.memory import Memory
from thinkgrasp.selection import nearest_point, preferred_point, rank_grasps
from thinkgrasp.types import Decision, Degradation, Frame, FunnelStep, Grasps, Scene, Segment, Segmentation

MAX_INSTRUCTION_CHARS = 2000


class Pipeline:
    """The five stages in a row: scene, plan, segments, grasps, checks; then the choice.

    Args:
        scene: Perception, or None for the paper's strict mode (no proposals, no graph, no support plane).
        planner: Chooses what to take.
        segmenter: Turns the plan into masks.
        generator: Proposes grasps on the union of the masks.
        checks: Filters by name, applied in order; each gets a line in the funnel.
        gripper: Geometry that generator and checks work with.
        n_nearest: How many grasps nearest to the preferred point compete on score.
        seed: Seeds the generator anew at every decision, so that a decision depends on its inputs alone.
    """

    def __init__(
        self,
        *,
        scene: ScenePerception | None,
        planner: Planner,
        segmenter: Segmenter,
        generator: GraspGenerator,
        checks: Mapping[str, Check],
        gripper: Gripper,
        n_nearest: int = 10,
        seed: int = 0,
    ) -> None:
        self.scene = scene
        self.planner = planner
        self.segmenter = segmenter
        self.generator = generator
        self.checks = dict(checks)
        self.gripper = gripper
        self.n_nearest = n_nearest
        self.seed = seed

    def decide(self, frame: Frame, instruction: str, memory: Memory | None = None) -> Decision:
        """Answer an instruction on one frame.

        Args:
            frame: Aligned RGB-D view; several views as `thinkgrasp.fusion.fuse` joins them.
            instruction: What a person said, 1..2000 characters.
            memory: What failed before on this scene.

        Returns:
            A decision with status "grasp", "no_target" (nothing in view fits or can hide it) or "no_grasp" (a target
            was found, but no grasp on it survived the checks).

        Raises:
            InputError: The instruction is empty or too long, or the frame has no depth at all.
            ContractError: A stage broke its contract.
        """
        instruction = check_instruction(instruction)
        clock = _Clock()

        scene = self._perceive(frame)
        clock.lap("scene")

        memory = (memory or Memory()).seen_from(frame.T_world_camera)
        plan = self.planner.plan(scene, instruction, memory)
        clock.lap("plan")
        fused = () if frame.others is None else frame.others.degraded
        degraded = (*fused, *scene.degraded, *plan.degraded)
        decision = Decision("no_target", instruction, scene, plan, degraded=degraded)
        if not plan.found:
            return replace(decision, timings_ms=clock.timings())

        segmentation = self.segmenter.segment(scene, plan)
        _check_segments(segmentation, frame)
        clock.lap("segment")
        degraded = (*degraded, *segmentation.degraded)
        if not segmentation.segments:
            return replace(decision, degraded=degraded, timings_ms=clock.timings())
        crop = np.logical_or.reduce([s.mask for s in segmentation.segments])

        grasps = self.generator.generate(scene, crop, self.gripper, np.random.default_rng(self.seed))
        clock.lap("generate")

        for target in segmentation.segments:
            kept, funnel = self._check(scene, target, grasps, memory)
            if len(kept):
                break
        else:
            target = segmentation.segments[0]
            kept, funnel = self._check(scene, target, grasps, memory)
        clock.lap("check")
        if target is not segmentation.segments[0]:
            reason = f"no grasp on the best match ({segmentation.segments[0].label}) survived the checks"
            degraded = (*degraded, Degradation("select", reason, f"the next match ({target.label})"))

        if plan.point_px is None:
            point = preferred_point(scene.points, target.mask, target.box_xyxy, plan.grid, plan.cell)
        else:
            point = nearest_point(scene.points, target.mask, plan.point_px)
        decision = replace(
            decision,
            status="no_grasp",
            target=target,
            crop=crop,
            preferred_point=point,
            funnel=funnel,
            degraded=degraded,
        )
        if point is None or not len(kept):
            return replace(decision, timings_ms=clock.timings())
        ranked = kept[rank_grasps(kept, point, self.n_nearest)]
        clock.lap("select")
        return replace(
            decision,
            status="grasp",
            grasp=ranked.at(0),
            alternatives=tuple(ranked[1:]),
            timings_ms=clock.timings(),
        )

    def _perceive(self, frame: Frame) -> Scene:
        if not (frame.depth > 0).any():
            raise InputError("the depth image holds no return at all (every pixel is 0 or NaN)")
        if self.scene is None:
            return Scene(frame, deproject(frame.depth, frame.camera))
        return self.scene.perceive(frame)

    def _check(
        self, scene: Scene, target: Segment, grasps: Grasps, memory: Memory
    ) -> tuple[Grasps, tuple[FunnelStep, ...]]:
        funnel = [FunnelStep("candidates", len(grasps), len(grasps))]
        if memory.attempts:
            new = ~memory.repeats(grasps)
            funnel.append(FunnelStep("not_failed_before", len(grasps), int(new.sum())))
            grasps = grasps[new]
        for name, check in self.checks.items():
            keep = check.keep(scene, target, grasps, self.gripper)
            if keep.shape != (len(grasps),) or keep.dtype != np.bool_:
                raise ContractError(f"check {name!r} must return ({len(grasps)},) bool, got {keep.shape} {keep.dtype}")
            funnel.append(FunnelStep(name, len(grasps), int(keep.sum())))
            grasps = grasps[keep]
        return grasps, tuple(funnel)


def check_instruction(instruction: str) -> str:
    """Return the instruction without surrounding space.

    Raises:
        InputError: It is empty or longer than MAX_INSTRUCTION_CHARS.
    """
    instruction = instruction.strip()
    if not instruction:
        raise InputError("the instruction is empty; say what to take, for example 'the red box'")
    if len(instruction) > MAX_INSTRUCTION_CHARS:
        raise InputError(
            f"the instruction has {len(instruction)} characters; at most {MAX_INSTRUCTION_CHARS} are allowed"
        )
    return instruction


def _check_segments(segmentation: Segmentation, frame: Frame) -> None:
    shape = frame.depth.shape
    for s in segmentation.segments:
        if s.mask.shape != shape or s.mask.dtype != np.bool_ or not s.mask.any():
            raise ContractError(
                f"segment {s.label!r} must be a non-empty {shape} boolean mask, got {s.mask.shape} {s.mask.dtype}"
            )


class _Clock:
    """Wall time between laps, and since the start."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self._laps: list[tuple[str, float]] = []

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self._laps.append((stage, (now - self._last) * 1e3))
        self._last = now

    def timings(self) -> tuple[tuple[str, float], ...]:
        return (*self._laps, ("total", (time.perf_counter() - self._start) * 1e3))
