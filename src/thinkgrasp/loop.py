"""The closed loop: observe, decide, execute, verify, remember, until the goal is delivered. Knows no simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from thinkgrasp.errors import ConfigError, ThinkGraspError
from thinkgrasp.fusion import fuse
from thinkgrasp.interfaces import Camera, Recorder, Robot
from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.pipeline import Pipeline, check_instruction
from thinkgrasp.types import Decision, Degradation, Frame, Outcome, Usage

End = Literal["goal_delivered", "step_limit", "nothing_left", "no_grasp", "budget_spent", "stopped"]
END_WORDS: dict[End, str] = {
    "goal_delivered": "the goal is in the bin",
    "step_limit": "all attempts are used up",
    "nothing_left": "nothing in view answers to the instruction or can hide it",
    "no_grasp": "no grasp on anything that could be taken survived the checks",
    "budget_spent": "the planner's budget for this episode is spent",
    "stopped": "whoever watches stopped the episode",
}

Fusion = Literal["never", "first", "last", "always"]
"""When the views of all cameras are fused in the first one's: never; where that one shows no grasp, before or after the
others are looked through one by one; or for every decision."""

Referee = Callable[[Decision, Outcome], bool]
"""Says after a successful attempt whether the goal was delivered: the person at the bin. Planning never sees it."""

MAX_REPLANS = 6
"""So many things without a grasp are put aside in one step before the step gives up."""
_NOT_FUSED = Degradation("fusion", "a camera's pose is unknown", "each view was looked at alone")
STILL_THERE_SHARE = 0.6
STILL_THERE_M = 0.004
"""A thing is still there where this share of its pixels has not moved by more than this."""
STILL_THERE_PIXELS = 20
"""Fewer with depth in both frames tell nothing."""


@dataclass(frozen=True, eq=False)
class Step:
    """One turn of the loop: what was decided, and what became of it (None: nothing was executed)."""

    decision: Decision
    outcome: Outcome | None
    duration_s: float


@dataclass(frozen=True, eq=False)
class Episode:
    """A whole run of the loop."""

    instruction: str
    steps: tuple[Step, ...]
    end: End
    usage: Usage = field(default_factory=Usage)
    """What all decisions cost, those that were not acted upon included."""

    @property
    def success(self) -> bool:
        """Whether the goal was delivered."""
        return self.end == "goal_delivered"

    @property
    def attempts(self) -> int:
        """How many grasps were executed."""
        return sum(s.outcome is not None for s in self.steps)


def run_episode(
    cameras: Sequence[Camera],
    pipeline: Pipeline,
    robot: Robot,
    instruction: str,
    *,
    step_limit: int = 15,
    referee: Referee | None = None,
    recorders: Iterable[Recorder] = (),
    stop: Callable[[], bool] = lambda: False,
    fusion: Fusion = "last",
) -> Episode:
    """Clear the way to the goal and deliver it.

    Args:
        cameras: The first one is looked through; the others only where it shows no grasp. Their poses must be known to
            share what was remembered, and to be fused.
        pipeline: One frame and the instruction to one decision.
        robot: Executes a grasp and puts what it holds away.
        instruction: What a person said.
        step_limit: At most so many attempts.
        referee: Says whether the goal was delivered; without one, a successful attempt at what the plan calls the goal
            counts.
        recorders: Told every step when it is finished.
        stop: Asked before every step.
        fusion: When the views of all cameras are fused.

    Returns:
        The steps and the named reason of the end.

    Raises:
        ConfigError: No camera, a step limit that is not positive, or no such fusion.
        InputError: The instruction is empty or too long.
    """
    if not cameras or step_limit < 1:
        raise ConfigError(f"an episode needs a camera and at least one step, got {len(cameras)} and {step_limit}")
    if fusion not in get_args(Fusion):
        raise ConfigError(f"no fusion {fusion!r}; allowed: {', '.join(get_args(Fusion))}")
    instruction = check_instruction(instruction)
    recorders = tuple(recorders)
    memory = Memory()
    steps: list[Step] = []
    usage = Usage()
    frame = cameras[0].read()

    def decide(frame: Frame, memory: Memory) -> Decision:
        nonlocal usage
        decision = pipeline.decide(frame, instruction, memory)
        usage += decision.plan.usage
        return decision

    def keep(decision: Decision, outcome: Outcome | None, start: float) -> None:
        steps.append(Step(decision, outcome, time.perf_counter() - start))
        for recorder in recorders:
            recorder.record(decision, outcome)

    def finish(end: End) -> Episode:
        return Episode(instruction, tuple(steps), end, usage)

    while len(steps) < step_limit:
        if stop():
            return finish("stopped")
        start = time.perf_counter()
        decision, memory = _decide(frame, cameras, decide, memory, fusion)
        outcome: Outcome | None = None
        if decision.grasp is not None:
            outcome = robot.execute(decision.grasp, decision.scene.frame)
            try:
                frame = cameras[0].read()
            except ThinkGraspError:  # what was executed is kept, whatever becomes of the camera
                keep(decision, outcome, start)
                raise
            if outcome.success and is_undone(decision, frame):
                outcome = Outcome(False, "still_there")
            memory = remember(memory, decision, outcome)
        keep(decision, outcome, start)
        if decision.plan.out_of_budget:
            return finish("budget_spent")
        if outcome is None:
            return finish("nothing_left" if decision.status == "no_target" else "no_grasp")
        if outcome.success and (referee(decision, outcome) if referee else decision.plan.role == "goal"):
            return finish("goal_delivered")
    return finish("step_limit")


def is_still_there(decision: Decision, after: Frame) -> bool:
    """Whether a thing that is said to be removed is seen where it was; both frames are of one camera at rest."""
    if decision.target is None:
        return False
    before = decision.scene.frame.depth[decision.target.mask]
    now = after.depth[decision.target.mask]
    seen = (before > 0) & (now > 0)
    if seen.sum() < STILL_THERE_PIXELS:
        return False
    same = np.abs(before[seen] - now[seen]) <= STILL_THERE_M
    return float(same.mean()) >= STILL_THERE_SHARE


def same_view(a: Frame, b: Frame) -> bool:
    """Whether two frames are of one camera at rest."""
    if a.T_world_camera is None or b.T_world_camera is None:
        return a.T_world_camera is b.T_world_camera and a.camera == b.camera
    return a.camera == b.camera and np.array_equal(a.T_world_camera, b.T_world_camera)


def _decide(
    frame: Frame,
    cameras: Sequence[Camera],
    decide: Callable[[Frame, Memory], Decision],
    memory: Memory,
    fusion: Fusion,
) -> tuple[Decision, Memory]:
    """Decide on this frame; where no grasp survives, from the other cameras, then on something else."""
    if fusion == "always":
        frame = _fused([frame, *(camera.read() for camera in cameras[1:])]) or frame
    decision = first = decide(frame, memory)
    for replans in range(MAX_REPLANS + 1):
        if decision.grasp is not None or decision.plan.out_of_budget:
            return decision, memory
        if decision is first or decision.status == "no_grasp":
            untried = memory
            # What the first view does not show is not planned for on the fused one either: the image is the same.
            for look in _looks(frame, cameras, fusion if decision.status == "no_grasp" else "never"):
                other = decide(look, memory if look.others is None else untried)
                if fusion != "never" and look.T_world_camera is None:
                    other = replace(other, degraded=(*other.degraded, _NOT_FUSED))
                if other.grasp is not None or other.plan.out_of_budget:
                    return other, memory
                if other.status == "no_grasp" and look.others is None:
                    memory = remember(memory, other, Outcome(False, "no_grasp"))
        if decision.status == "no_target" or replans == MAX_REPLANS:
            break
        memory = remember(memory, decision, Outcome(False, "no_grasp"))
        decision = decide(frame, memory)
    return first, memory


def _looks(frame: Frame, cameras: Sequence[Camera], fusion: Fusion) -> Iterator[Frame]:
    """Other views than this frame of the first camera: the other cameras' alone, and all of them fused."""
    frames = [frame]
    if fusion == "first" and len(cameras) > 1:
        frames += [camera.read() for camera in cameras[1:]]
        fused = _fused(frames)
        yield from frames[1:] if fused is None else (fused, *frames[1:])
        return
    for camera in cameras[1:]:
        frames.append(camera.read())
        yield frames[-1]
    if fusion == "last" and (fused := _fused(frames)) is not None:
        yield fused


def _fused(frames: list[Frame]) -> Frame | None:
    """The frames fused in the first one's camera; None where there is nothing to fuse or a pose is unknown."""
    return None if len(frames) < 2 or any(f.T_world_camera is None for f in frames) else fuse(frames)


def remember(memory: Memory, decision: Decision, outcome: Outcome) -> Memory:
    """Return the memory with this attempt, placed where the thing's centre was; unchanged where that is not known."""
    scene, plan = decision.scene, decision.plan
    mark = decision.target.mark if decision.target is not None else plan.mark
    if mark is not None:
        center = scene.proposal(mark).center_m
    elif decision.preferred_point is not None:
        center = decision.preferred_point
    else:
        return memory
    memory = memory.seen_from(scene.frame.T_world_camera)
    return memory.remember(Attempt(plan.target, plan.cell, decision.grasp, np.asarray(center, np.float64), outcome))


def decide_on_view(
    frame: Frame, decide: Callable[[Frame, Memory], Decision], memory: Memory
) -> tuple[Decision, Memory]:
    """Decide as one step of `run_episode` does with one camera, and return the memory with what had no grasp."""
    return _decide(frame, (), decide, memory, "never")


def is_undone(decision: Decision, after: Frame) -> bool:
    """Whether a later frame of the same view shows what was said to be removed where it was."""
    return same_view(decision.scene.frame, after) and is_still_there(decision, after)
