"""Which stage cost an episode, by the simulator's truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from thinkgrasp.benchmark.records import CRASHED, NO_SCENE, EpisodeKey, EpisodeRecord, SceneRecord, StepRecord
from thinkgrasp.outputs import one_line

Stage = Literal["no episode", "lost goal", "budget", "grasping", "reachability", "recognition", "clearing"]
STAGES: dict[Stage, str] = {
    "recognition": "a goal was in view and could be taken, but was never chosen",
    "reachability": "a goal was chosen, but no grasp on it survived the checks",
    "grasping": "grasps at a goal failed",
    "clearing": "no goal was ever in view, or none was ever free to be taken",
    "lost goal": "every goal left the table without being delivered",
    "budget": "the planner's budget was spent, or someone stopped it",
    "no episode": "it crashed, or there was no pile",
}
"""What each means."""


@dataclass(frozen=True)
class Failure:
    """A failed episode."""

    key: EpisodeKey
    end: str
    steps: int
    stage: Stage
    detail: str


def failure(episode: EpisodeRecord, steps: Sequence[StepRecord], scene: SceneRecord | None) -> Failure:
    """Say what a failed episode failed of; the first of several that applies, from the end of the chain backwards."""
    stage, detail = _stage(episode, steps, scene)
    return Failure(episode.key, episode.end, episode.steps, stage, detail)


def _stage(episode: EpisodeRecord, steps: Sequence[StepRecord], scene: SceneRecord | None) -> tuple[Stage, str]:
    if episode.end in (CRASHED, NO_SCENE):
        return "no episode", one_line(episode.error.partition("\n")[0]) or episode.end
    executed = [step for step in steps if step.is_executed]
    goals = set(scene.goals) if scene else set[str]()
    if goals and episode.goals_lost == len(goals):
        taking = [step for step in executed if goals & {*step.moved_out, step.delivered}]
        return "lost goal", counted(f"{step.reason} at {step.aimed or 'nothing'}" for step in taking)
    if episode.end in ("budget_spent", "stopped"):
        return "budget", f"{episode.end} after {len(steps)} decisions"
    if at_goal := [step for step in executed if step.is_goal_aimed]:
        return "grasping", counted(step.reason or "" for step in at_goal)
    if aimed := [step for step in steps if step.is_goal_aimed]:
        return "reachability", f"seen as {aimed[-1].target!r}"
    tried = counted(f"{step.reason} at {step.aimed or 'nothing'}" for step in executed) or "nothing"
    if not any(step.is_goal_in_view for step in steps):
        return "clearing", f"no goal was ever in view; tried {tried}"
    if not any(step.is_goal_in_view and step.is_goal_takeable for step in steps):
        return "clearing", f"a goal was in view, but never free; tried {tried}"
    wrong = counted(step.aimed or "nothing" for step in steps if step.role == "goal" and step.status == "grasp")
    return "recognition", f"taken for it: {wrong or 'nothing'}"


def counted(things: Iterable[str]) -> str:
    """Return "slipped 3, missed 1", most frequent first."""
    counts = Counter(things)
    return ", ".join(f"{thing} {n}" for thing, n in sorted(counts.items(), key=lambda item: (-item[1], item[0])))
