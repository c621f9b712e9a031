"""What a worker is asked, how it answers, and the work itself: from uploaded files to a published decision.

Everything here is picklable and knows nothing of HTTP.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ContractError
from thinkgrasp.interfaces import Planner
from thinkgrasp.loop import STILL_THERE_PIXELS, decide_on_view, is_still_there, remember, same_view
from thinkgrasp.memory import Memory
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.schema import DEFAULT_STANDOFF_M, MAX_ALTERNATIVES, DecisionModel, decision_to_schema
from thinkgrasp.server.decoding import FrameUpload, decode_frame, without_paths
from thinkgrasp.server.graspnet_pose import Pose, to_graspnet
from thinkgrasp.types import CameraIntrinsics, Decision, Frame, Outcome, Plan, Scene, Segment, Usage

Announce = Callable[[str], None]
"""Told each stage before it runs; what it raises ends the job."""

PENDING = Outcome(False, "pending")
"""Stands for the outcome of an attempt until its client reports it."""
STILL_THERE = Outcome(False, "still_there")
MAX_SIGHTING_PIXELS = 20_000
"""Of a target, evenly spread: an episode that waits keeps no more."""


@dataclass(frozen=True)
class Settings:
    """What a client may set of a decision; None = as the server is configured."""

    seed: int | None = None
    n_nearest: int | None = None
    standoff_m: float = DEFAULT_STANDOFF_M
    alternatives: int = MAX_ALTERNATIVES
    mask: bool = True


@dataclass(frozen=True, eq=False)
class Sighting:
    """What is kept of a decision to see later whether its target is still in its place."""

    camera: CameraIntrinsics
    T_world_camera: NDArray[np.float64] | None
    pixels: NDArray[np.int32]
    """(N,) flat indices of the target's mask."""
    depth: NDArray[np.float32]
    """(N,) [m] there."""

    @classmethod
    def of(cls, decision: Decision) -> Sighting | None:
        """Return what has to be kept; None where there is no target."""
        if decision.target is None:
            return None
        frame, pixels = decision.scene.frame, np.flatnonzero(decision.target.mask)
        pixels = pixels[:: math.ceil(len(pixels) / MAX_SIGHTING_PIXELS)]
        return cls(frame.camera, frame.T_world_camera, pixels.astype(np.int32), frame.depth.ravel()[pixels])

    def is_in(self, after: Frame) -> bool | None:
        """Whether a later frame shows the target where it was; None for one of another view, or without depth there."""
        size = (self.camera.height, self.camera.width)
        depth, mask = np.zeros(size, np.float32), np.zeros(size, np.bool_)
        depth.flat[self.pixels], mask.flat[self.pixels] = self.depth, True
        frame = Frame(np.zeros((*size, 3), np.uint8), depth, self.camera, self.T_world_camera)
        if not same_view(frame, after) or ((depth > 0) & (after.depth > 0)).sum() < STILL_THERE_PIXELS:
            return None
        scene = Scene(frame, np.zeros((*size, 3), np.float32))
        target = Segment("", 1.0, mask, (0, 0, size[1], size[0]), False)
        return is_still_there(Decision("grasp", "", scene, Plan("", ""), target), after)


@dataclass(frozen=True)
class Decide:
    """Decide on one frame, as the first step of nothing or as a step of an episode."""

    frame: FrameUpload
    instruction: str
    settings: Settings = Settings()
    memory: Memory | None = None
    """What an episode remembers; None: a decision by itself, which takes no second look."""
    last: Sighting | None = None
    """The target of the last attempt, where it is said to be removed."""
    more_views: bool = False
    """Do not put aside what has no grasp in this view: another view follows."""
    budget_usd: float | None = None
    """What is left of the planner's budget; None = no limit."""
    pictures: bool = False
    pose: bool = False
    """Whether the grasp in GraspNet's convention is wanted."""


@dataclass(frozen=True)
class Verify:
    """See whether the target of the last attempt is gone from its place."""

    frame: FrameUpload
    last: Sighting


Job = Decide | Verify


@dataclass(frozen=True)
class Decided:
    """What became of a Decide."""

    decision: DecisionModel
    usage: Usage
    """Of all decisions that the step took."""
    out_of_budget: bool = False
    overlay_png: str | None = None
    view_html: str | None = None
    pose: Pose | None = None
    memory: Memory | None = None
    """What is remembered after the step, had nothing been executed."""
    attempted: Memory | None = None
    """The same with the attempt, whose outcome is PENDING; None where there is no grasp."""
    sighting: Sighting | None = None
    undone: bool = False


@dataclass(frozen=True)
class Verified:
    """What became of a Verify."""

    still_there: bool | None
    """Whether the target is where it was; None where the frame cannot tell."""


Answer = Decided | Verified


class Desk:
    """Carries jobs out with one pipeline.

    Args:
        pipeline: Its stages are announced before they run.
        announce: Told the stages.
        max_pixels: Of an image.
        new_planner: Makes the planner anew with a budget [USD]; None where budgets mean nothing to it.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        announce: Announce,
        *,
        max_pixels: int,
        new_planner: Callable[[float], Planner] | None = None,
    ) -> None:
        self._pipeline = _announcing(pipeline, announce)
        self._announce = announce
        self._max_pixels = max_pixels
        self._new_planner = new_planner
        self._seed, self._n_nearest = pipeline.seed, pipeline.n_nearest

    def carry_out(self, job: Job) -> Answer:
        """Carry one job out.

        Raises:
            InputError: The frame or the instruction cannot be used.
        """
        self._announce("decode")
        frame = decode_frame(job.frame, self._max_pixels)
        if isinstance(job, Verify):
            return Verified(job.last.is_in(frame))
        return self._decide(job, frame)

    def _decide(self, job: Decide, frame: Frame) -> Decided:
        pipeline, settings = self._pipeline, job.settings
        pipeline.seed = self._seed if settings.seed is None else settings.seed
        pipeline.n_nearest = self._n_nearest if settings.n_nearest is None else settings.n_nearest
        if job.budget_usd is not None and self._new_planner is not None:
            pipeline.planner = _announced(self._new_planner(max(job.budget_usd, 0.0)), "plan", "plan", self._announce)
        memory, undone, usage = job.memory, False, Usage()
        if memory is not None and job.last is not None and job.last.is_in(frame):
            memory, undone = with_last_outcome(memory, STILL_THERE), True

        def decide(frame: Frame, memory: Memory) -> Decision:
            nonlocal usage
            decision = pipeline.decide(frame, job.instruction, memory)
            usage += decision.plan.usage
            return decision

        if memory is None:
            decision = decide(frame, Memory())
            return self._published(job, decision, usage)
        if job.more_views:
            decision = decide(frame, memory)
        else:
            decision, memory = decide_on_view(frame, decide, memory)
        attempted = remember(memory, decision, PENDING) if decision.grasp is not None else None
        answer = self._published(job, decision, usage)
        return replace(answer, memory=memory, attempted=attempted, sighting=Sighting.of(decision), undone=undone)

    def _published(self, job: Decide, decision: Decision, usage: Usage) -> Decided:
        self._announce("pictures")
        settings = job.settings
        model = decision_to_schema(decision, standoff_m=settings.standoff_m, with_mask=settings.mask)
        model = model.model_copy(
            update={
                "alternatives": model.alternatives[: settings.alternatives],
                "degraded": tuple(d.model_copy(update={"reason": without_paths(d.reason)}) for d in model.degraded),
                "plan": model.plan.model_copy(update={"rationale": without_paths(model.plan.rationale)}),
            }
        )
        pose = to_graspnet(decision) if job.pose else None
        answer = Decided(model, usage, decision.plan.out_of_budget, pose=pose)
        return replace(answer, **self._pictures(decision)) if job.pictures else answer

    def _pictures(self, decision: Decision) -> dict[str, Any]:
        from thinkgrasp.viz.overlay import draw_overlay
        from thinkgrasp.viz.view import render_view

        buffer = io.BytesIO()
        draw_overlay(decision, self._pipeline.gripper).convert("RGB").save(buffer, "PNG")
        return {
            "overlay_png": base64.b64encode(buffer.getvalue()).decode("ascii"),
            "view_html": render_view(decision, self._pipeline.gripper),
        }


def with_last_outcome(memory: Memory, outcome: Outcome) -> Memory:
    """Return the memory with another outcome of its last attempt."""
    if not memory.attempts:
        raise ContractError("there is no attempt whose outcome could be told")
    return replace(memory, attempts=(*memory.attempts[:-1], replace(memory.attempts[-1], outcome=outcome)))


def _announcing(pipeline: Pipeline, announce: Announce) -> Pipeline:
    """Return a pipeline of the same stages, each of which says its name before it runs."""
    return Pipeline(
        scene=None if pipeline.scene is None else _announced(pipeline.scene, "perceive", "scene", announce),
        planner=_announced(pipeline.planner, "plan", "plan", announce),
        segmenter=_announced(pipeline.segmenter, "segment", "segment", announce),
        generator=_announced(pipeline.generator, "generate", "generate", announce),
        checks={name: _announced(check, "keep", "check", announce) for name, check in pipeline.checks.items()},
        gripper=pipeline.gripper,
        n_nearest=pipeline.n_nearest,
        seed=pipeline.seed,
    )


def _announced(stage: object, method: str, name: str, announce: Announce) -> Any:
    inner = getattr(stage, method)

    def run(*args: object) -> object:
        announce(name)
        return inner(*args)

    return SimpleNamespace(**{method: run})
