"""What a benchmark keeps: lines about scenes, steps and episodes, in one file that survives a kill at any moment.

DIR/records.jsonl holds one JSON object per line, each on the disk before the next step is taken. An episode counts once
its own line is there; the steps of one that was cut off are dropped when the run goes on.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.outputs import write_atomic
from thinkgrasp.types import Usage

RECORDS_FILE = "records.jsonl"
NO_SCENE, CRASHED = "no_scene", "crashed"
"""Ends of what was no episode, or never came to an end of it; the others are those of the loop."""


class SceneKey(NamedTuple):
    """Which pile."""

    task: str
    seed: int


class EpisodeKey(NamedTuple):
    """Which episode."""

    method: str
    task: str
    seed: int


@dataclass(frozen=True)
class SceneRecord:
    """A pile, the same for every method."""

    task: str
    seed: int
    instruction: str
    goals: tuple[str, ...] = ()
    visible: tuple[float, ...] = ()
    """Of each goal, the share 0..1 of its pixels that nothing hid at the start."""
    n_objects: int = 0
    fewest: int | None = None
    """Fewest grasps until a goal is out, searched in the simulator; None = not found."""
    is_fewest_exact: bool = False
    """Whether the search was complete; otherwise `fewest` may be too many."""
    seconds: float = 0.0
    error: str = ""
    """Why there is no pile."""
    kind: Literal["scene"] = "scene"

    @property
    def key(self) -> SceneKey:
        """What it is of."""
        return SceneKey(self.task, self.seed)


@dataclass(frozen=True)
class StepRecord:
    """One turn of the loop, tied to the simulator's truth; empty names stand for nothing."""

    method: str
    task: str
    seed: int
    step: int
    """From 1."""
    status: Literal["grasp", "no_target", "no_grasp"]
    role: Literal["goal", "obstruction"]
    target: str
    """What the plan calls it."""
    aimed: str
    """The object whose pixels the target truly are."""
    is_goal_aimed: bool
    is_goal_in_view: bool
    is_goal_takeable: bool
    """Whether a grasp on a goal existed, by the simulator's truth."""
    is_right: bool | None
    """Whether the goal was chosen where it could be taken, else a true obstruction; None = nothing was chosen."""
    chance: float | None
    """Probability that any object in view, picked blindly, would have been right."""
    reason: str | None
    """What became of the grasp; None = nothing was executed."""
    touched: str
    """What both fingers held after closing."""
    delivered: str
    is_goal_touched: bool
    is_goal_delivered: bool
    moved_out: tuple[str, ...]
    """What left the table without being taken."""
    toppled: tuple[str, ...]
    degraded: tuple[str, ...]
    """Stage and fallback of each."""
    timings_ms: tuple[tuple[str, float], ...]
    """Wall time of the stages of the decision."""
    seconds: float
    """Wall time of all but the decision: execution, the next frame, decisions for things put aside."""
    usage: Usage
    kind: Literal["step"] = "step"

    @property
    def key(self) -> EpisodeKey:
        """Of its episode."""
        return EpisodeKey(self.method, self.task, self.seed)

    @property
    def is_executed(self) -> bool:
        """Whether a grasp was tried."""
        return self.reason is not None

    @property
    def is_wrong_delivery(self) -> bool:
        """Whether another object was delivered as the goal."""
        return self.role == "goal" and bool(self.delivered) and not self.is_goal_delivered


@dataclass(frozen=True)
class EpisodeRecord:
    """A finished episode."""

    method: str
    task: str
    seed: int
    success: bool
    end: str
    """Named reason: one of `thinkgrasp.loop.End`, NO_SCENE or CRASHED."""
    steps: int
    """Executed grasps."""
    goals_lost: int = 0
    """Goals that lay neither on the table nor in the bin at the end."""
    usage: Usage = field(default_factory=Usage)
    """Of all decisions, those that were not acted upon included."""
    seconds: float = 0.0
    error: str = ""
    kind: Literal["episode"] = "episode"

    @property
    def key(self) -> EpisodeKey:
        """What it is of."""
        return EpisodeKey(self.method, self.task, self.seed)


Record = SceneRecord | StepRecord | EpisodeRecord
_RECORD: TypeAdapter[Record] = TypeAdapter(Annotated[Record, Field(discriminator="kind")])


class Records:
    """Everything that a folder holds, by key.

    Args:
        records: In the order of the file.

    Raises:
        InputError: A scene or an episode occurs twice.
    """

    def __init__(self, records: Iterable[Record] = ()) -> None:
        self.scenes: dict[SceneKey, SceneRecord] = {}
        self.episodes: dict[EpisodeKey, EpisodeRecord] = {}
        self.steps: dict[EpisodeKey, list[StepRecord]] = {}
        """In their order; unfinished episodes included."""
        for record in records:
            self.add(record)

    def add(self, record: Record) -> None:
        """Take one more record in.

        Raises:
            InputError: A scene or an episode is there already, or a step does not follow the one before.
        """
        if isinstance(record, StepRecord):
            steps = self.steps.setdefault(record.key, [])
            if record.step != len(steps) + 1 or record.key in self.episodes:
                raise InputError(f"step {record.step} of {' '.join(map(str, record.key))} follows {len(steps)} steps")
            steps.append(record)
        elif isinstance(record, SceneRecord):
            _insert(self.scenes, record.key, record)
        else:
            _insert(self.episodes, record.key, record)

    def all(self) -> Iterable[Record]:
        """Yield scenes, then the steps of every episode, each followed by the episode where it is finished."""
        yield from self.scenes.values()
        for key in dict.fromkeys((*self.steps, *self.episodes)):
            yield from self.steps.get(key, ())
            if key in self.episodes:
                yield self.episodes[key]


def _insert(into: dict, key: tuple[str | int, ...], record: Record) -> None:  # pyright: ignore
    if key in into:
        raise InputError(f"{record.kind} {' '.join(map(str, key))} occurs twice")
    into[key] = record


def read_records(folder: Path) -> Records:
    """Read what a folder holds; a torn last line is left out.

    Raises:
        InputError: There are no records, or they cannot be understood; the message names the line.
    """
    path = folder / RECORDS_FILE
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); is {folder} the folder of a benchmark?"
        ) from error
    records = Records()
    for number, line in enumerate(content[: content.rfind(b"\n") + 1].splitlines(), 1):
        try:
            records.add(_RECORD.validate_json(line))
        except (ValidationError, InputError) as error:
            reason = error if isinstance(error, InputError) else error.errors()[0]["msg"]
            raise InputError(f"{path}:{number}: is no record of a benchmark: {reason}") from error
    return records


class RecordLog:
    """The file of records, open for one process to write.

    Args:
        folder: Where it is or will be.
        drop: Finished episodes to forget, so that they can run again; a pile that failed is forgotten with its last.

    Raises:
        ConfigError: Another process is writing.
        InputError: It cannot be read or written.
    """

    def __init__(self, folder: Path, drop: Callable[[EpisodeRecord], bool] = lambda episode: False) -> None:
        self._path = folder / RECORDS_FILE
        self._lock = (folder / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise ConfigError(f"another benchmark is writing to {folder}; wait for it or take another --out") from error
        self.records = read_records(folder) if self._path.exists() else Records()
        for key in [key for key, episode in self.records.episodes.items() if drop(episode)]:
            del self.records.episodes[key]
        for key in self.records.steps.keys() - self.records.episodes.keys():
            del self.records.steps[key]
        used = {SceneKey(*key[1:]) for key in self.records.episodes}
        for key in [key for key, scene in self.records.scenes.items() if scene.error and key not in used]:
            del self.records.scenes[key]
        self._rewrite()
        self._file = self._path.open("ab")

    def __enter__(self) -> RecordLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._lock.close()

    def add(self, record: Record) -> None:
        """Append a record and wait until it is on the disk."""
        self.records.add(record)
        self._file.write(_RECORD.dump_json(record) + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def forget(self, key: EpisodeKey) -> None:
        """Drop the steps of an episode that will be started anew."""
        if self.records.steps.pop(key, None):
            self._file.close()
            self._rewrite()
            self._file = self._path.open("ab")

    def _rewrite(self) -> None:
        data = b"".join(_RECORD.dump_json(record) + b"\n" for record in self.records.all())
        write_atomic(self._path, data)
