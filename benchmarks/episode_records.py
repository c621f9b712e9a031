"""What is kept of a finished episode, one JSON line each, and why an episode failed, by the simulator's truth."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import TypeAdapter

SCHEMA = "thinkgrasp/bench-episode-1"


@dataclass(frozen=True)
class Look:
    """What one decision was about, and what was in view when it was made."""

    status: str
    target: str
    """What the plan calls it."""
    role: str
    aimed: str
    """Name of the object whose pixels the target truly are; empty where there was no target."""
    is_goal_aimed: bool
    is_goal_in_view: bool
    decision_ms: float


@dataclass(frozen=True)
class Tried:
    """One executed grasp; empty names stand for nothing."""

    look: Look
    reason: str
    touched: str
    """What both fingers held after closing."""
    delivered: str
    is_goal_touched: bool
    is_goal_delivered: bool
    moved_out: tuple[str, ...]
    """What left the table without being taken."""
    seconds: float
    """Wall time of all but the decision: execution, the next frame, decisions for things put aside."""

    @property
    def held(self) -> bool:
        """Whether the robot verified twice that it held the thing, and let it go over the bin."""
        return self.reason == "held"

    @property
    def is_wrong_delivery(self) -> bool:
        """Whether another object was delivered as the goal."""
        return self.look.role == "goal" and bool(self.delivered) and not self.is_goal_delivered


@dataclass(frozen=True)
class EpisodeRecord:
    """A finished episode."""

    schema: str
    suite: str
    task: str
    seed: int
    preset: str
    size: tuple[int, int]
    instruction: str
    goals: tuple[str, ...]
    visible: tuple[float, ...]
    """Of each goal, the share of its pixels that nothing hid at the start."""
    n_objects: int
    success: bool
    end: str
    """Named reason; "no_scene" or "crashed" where there was no episode, or no end of it."""
    steps: int
    """Executed grasps."""
    attempts: tuple[Tried, ...]
    unanswered: Look | None
    """The decision that ended the episode because nothing could be executed."""
    lost: tuple[str, ...]
    """Objects that left the table untaken."""
    goals_lost: int
    """Goals that lay neither on the table nor in the bin at the end."""
    seconds: float
    error: str = ""

    @property
    def key(self) -> tuple[str, int, str, tuple[int, int]]:
        """What the episode was of; two records with one key are the same episode."""
        return self.task, self.seed, self.preset, self.size


Record = TypeVar("Record")


class RecordLog(Generic[Record]):
    """A file of records that survives the end of the process at any moment; a torn last line is cut off.

    Args:
        path: Appended to when it exists; None = nothing is written.
        kind: The records' class.
    """

    def __init__(self, path: Path | None, kind: type[Record]) -> None:
        self._path = path
        self._adapter = TypeAdapter(kind)
        self.records: list[Record] = []
        if path is None or not path.exists():
            return
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.truncate(path, len(whole))
        self.records = [self._adapter.validate_json(line) for line in whole.splitlines()]

    def add(self, record: Record) -> None:
        """Append a record and wait until it is on the disk."""
        self.records.append(record)
        if self._path is None:
            return
        with self._path.open("ab") as file:
            file.write(self._adapter.dump_json(record) + b"\n")
            file.flush()
            os.fsync(file.fileno())


def why_failed(episode: EpisodeRecord) -> tuple[str, str]:
    """Return the kind of a failure, by the simulator's truth, and its particulars."""
    if episode.error:
        return "no episode", episode.error
    tried = episode.attempts
    at_goal = [t for t in tried if t.look.is_goal_aimed]
    looks = [t.look for t in tried] + ([episode.unanswered] if episode.unanswered else [])
    if episode.goals_lost == len(episode.goals):
        goals = set(episode.goals)
        taking = [t for t in tried if goals & {*t.moved_out, t.delivered}]
        return "every goal left the table", counted(f"{t.reason} at {t.look.aimed or 'nothing'}" for t in taking)
    if at_goal:
        return "grasps at a goal failed", counted(t.reason for t in at_goal)
    if any(look.is_goal_aimed for look in looks):
        return "no grasp on a goal survived the checks", f"seen as {looks[-1].target!r}"
    if not any(look.is_goal_in_view for look in looks):
        return "no goal was ever in view", f"tried {counted(t.reason for t in tried) or 'nothing'}"
    wrong = counted(look.aimed or "nothing" for look in looks if look.role == "goal" and look.status == "grasp")
    return "a goal was in view, but not recognised", f"taken for it: {wrong or 'nothing'}"


def counted(things: Iterable[str]) -> str:
    """Return "slipped 3, missed 1", most frequent first."""
    counts = Counter(things)
    return ", ".join(f"{thing} {n}" for thing, n in sorted(counts.items(), key=lambda item: (-item[1], item[0])))
