"""What a method must beat, and what it loses without one of its parts.

Floors take no notice of the instruction: a random object with its best grasp, or the best grasp anywhere. Ablations
take one part away from a pipeline: the memory of what failed, or the obstruction graph.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thinkgrasp.interfaces import ScenePerception
from thinkgrasp.memory import Memory
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Decision, Frame, Plan, Proposal, Scene, Segment, Segmentation

ANY_NUMBER = 1_000_000
"""As `n_nearest`: every grasp competes on its score."""


class RandomObject:
    """A planner that takes any proposal, whatever was asked for.

    Args:
        seed: Of the choices.
    """

    def __init__(self, *, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Choose a mark; those without a grasp since the last removal are passed over."""
        marks = [p.mark for p in scene.proposals if not memory.has_no_grasp(p)]
        if not marks:
            return Plan("", "there is nothing in view", found=False)
        mark = int(self._rng.choice(marks))
        return Plan(f"mark {mark}", "any object", mark=mark, cell=middle_cell(3))


class PlannedMark:
    """A segmenter that returns the planned proposal alone."""

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return its mask."""
        return Segmentation(() if plan.mark is None else (_segment(scene.proposal(plan.mark), plan.target),))


class _Everything:
    """Plans and segments all proposals as one thing."""

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        return Plan("anything", "the best grasp anywhere", found=bool(scene.proposals), cell=middle_cell(3))

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        mask = np.logical_or.reduce([p.mask for p in scene.proposals])
        v, u = np.nonzero(mask)
        box = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
        return Segmentation((Segment(plan.target, 1.0, mask, box, touches_border=False),))


class BestScore(Pipeline):
    """A pipeline that takes the best-scoring grasp of the whole table; its target is the object under it."""

    @classmethod
    def of(cls, pipeline: Pipeline) -> BestScore:
        """Return it with the perception, generator and checks of a pipeline."""
        everything = _Everything()
        return cls(
            scene=pipeline.scene, planner=everything, segmenter=everything, generator=pipeline.generator,
            checks=pipeline.checks, gripper=pipeline.gripper, n_nearest=ANY_NUMBER, seed=pipeline.seed,
        )  # fmt: skip

    def decide(self, frame: Frame, instruction: str, memory: Memory | None = None) -> Decision:
        """Decide, and name what the grasp is on."""
        decision = super().decide(frame, instruction, memory)
        if decision.grasp is None:
            return decision
        scene, tip = decision.scene, decision.grasp.position

        def distance(p: Proposal) -> float:
            return float(np.nanmin(np.linalg.norm(scene.points[p.mask] - tip, axis=1)))

        nearest = min(scene.proposals, key=distance)
        target = _segment(nearest, f"mark {nearest.mark}")
        return replace(decision, target=target, plan=replace(decision.plan, target=target.label, mark=nearest.mark))


class Forgetful(Pipeline):
    """A pipeline that remembers nothing of what failed."""

    @classmethod
    def of(cls, pipeline: Pipeline) -> Forgetful:
        """Return it with the stages of a pipeline."""
        return cls(
            scene=pipeline.scene, planner=pipeline.planner, segmenter=pipeline.segmenter, generator=pipeline.generator,
            checks=pipeline.checks, gripper=pipeline.gripper, n_nearest=pipeline.n_nearest, seed=pipeline.seed,
        )  # fmt: skip

    def decide(self, frame: Frame, instruction: str, memory: Memory | None = None) -> Decision:
        """Decide as if it were the first attempt."""
        return super().decide(frame, instruction, None)


class WithoutGraph(ScenePerception):
    """A perception whose scenes know not what hides what.

    Args:
        perception: What perceives all the rest.
    """

    def __init__(self, perception: ScenePerception) -> None:
        self._perception = perception

    def perceive(self, frame: Frame) -> Scene:
        """Return the scene without its obstructions."""
        return replace(self._perception.perceive(frame), obstructions=())


def _segment(proposal: Proposal, label: str) -> Segment:
    return Segment(label, 1.0, proposal.mask, proposal.box_xyxy, proposal.touches_border, proposal.mark)
