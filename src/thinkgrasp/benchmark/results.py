"""What result folders hold, put together by suite and checked to be of the same piles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from thinkgrasp.benchmark.methods import Method
from thinkgrasp.benchmark.plan import BenchmarkPlan, Session, read_plan
from thinkgrasp.benchmark.records import (
    EpisodeKey,
    EpisodeRecord,
    Record,
    Records,
    SceneRecord,
    StepRecord,
    read_records,
)
from thinkgrasp.errors import InputError
from thinkgrasp.sim.tasks import STEP_LIMIT
from thinkgrasp.types import Usage


@dataclass(frozen=True, eq=False)
class Results:
    """The records of one suite, with what was planned."""

    plan: BenchmarkPlan
    """Of the first folder, with the methods and sessions of all."""
    records: Records
    planned: frozenset[EpisodeKey]
    folders: tuple[Path, ...]

    @property
    def suite(self) -> str:
        """Name of the suite."""
        return self.plan.source.name

    @property
    def step_limit(self) -> int:
        """Attempts after which an episode ends."""
        return STEP_LIMIT[self.plan.source.group]

    @property
    def methods(self) -> tuple[str, ...]:
        """In the order of the plans; those without a finished episode are left out."""
        found = {key.method for key in self.records.episodes}
        return tuple(method.name for method in self.plan.methods if method.name in found)

    def episodes(self, method: str) -> dict[EpisodeKey, EpisodeRecord]:
        """Return a method's finished episodes, by task in the plan's order and by seed."""
        place = {task: i for i, task in enumerate(self.plan.tasks)}
        found = [key for key in self.records.episodes if key.method == method]
        found.sort(key=lambda key: (place.get(key.task, len(place)), key.task, key.seed))
        return {key: self.records.episodes[key] for key in found}


def load_results(folders: Sequence[Path]) -> tuple[Results, ...]:
    """Read result folders, one result per suite, in the order of the folders.

    Raises:
        InputError: A folder is none of a benchmark, or folders of one suite do not fit together; the message says why.
    """
    by_suite: dict[str, Results] = {}
    for folder in _distinct(folders):
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder; give the folder of a benchmark")
        plan, records = read_plan(folder), read_records(folder)
        keys = (EpisodeKey(m.name, task, seed) for m in plan.methods for task in plan.tasks for seed in plan.seeds)
        found = Results(plan, records, frozenset(keys), (folder,))
        known = by_suite.get(found.suite)
        by_suite[found.suite] = found if known is None else _joined(known, found)
    for results in by_suite.values():
        if not results.records.episodes:
            raise InputError(
                f"{', '.join(map(str, results.folders))}: no episode of {results.suite} is finished yet; "
                "run `thinkgrasp bench run --out` of the same folder until the first is"
            )
    return tuple(by_suite.values())


def _distinct(folders: Sequence[Path]) -> list[Path]:
    found: dict[Path, Path] = {}
    for folder in folders:
        found.setdefault(folder.resolve(), folder)
    return list(found.values())


def _joined(a: Results, b: Results) -> Results:
    where = f"{a.folders[0]} and {b.folders[0]}, both of {a.suite},"
    if a.plan.camera != b.plan.camera:
        raise InputError(f"{where} saw with other cameras: {a.plan.camera} and {b.plan.camera}; report on each alone")
    methods: dict[str, Method] = {method.name: method for method in a.plan.methods}
    for method in b.plan.methods:
        if methods.setdefault(method.name, method) != method:
            raise InputError(
                f"{where} hold other methods by the name {method.name!r}; `bench compare` shows what differs"
            )
    joined = Records(a.records.all())
    for scene in b.records.scenes.values():
        mine = joined.scenes.get(scene.key)
        if mine is None:
            joined.add(scene)
        elif _pile(mine) != _pile(scene):
            raise InputError(
                f"{where} have other piles for {scene.task} seed {scene.seed}: {_named(mine)} and {_named(scene)}; "
                "they cannot stand in one table. Were they made by other versions, layouts or objects?"
            )
    for key, episode in b.records.episodes.items():
        if key in joined.episodes:
            mine = joined.steps.get(key, []), joined.episodes[key]
            if not same_episode(mine, (b.records.steps.get(key, []), episode)):
                name = " ".join(map(str, key))
                raise InputError(f"{where} have other results of {name}; `bench compare` shows what differs")
            continue
        joined.steps.pop(key, None)
        for step in b.records.steps.get(key, ()):
            joined.add(step)
        joined.add(episode)
    sessions: tuple[Session, ...] = tuple(sorted((*a.plan.sessions, *b.plan.sessions), key=lambda s: s.started))
    tasks = tuple(dict.fromkeys((*a.plan.tasks, *b.plan.tasks)))
    plan = replace(a.plan, tasks=tasks, methods=tuple(methods.values()), sessions=sessions)
    return Results(plan, joined, a.planned | b.planned, (*a.folders, *b.folders))


def _pile(scene: SceneRecord) -> SceneRecord:
    """Return what must be the same of a pile: not what was searched in it, nor how long."""
    return replace(scene, fewest=None, is_fewest_exact=False, seconds=0.0, error=scene.error and "none")


def _named(scene: SceneRecord) -> str:
    if scene.error:
        return "none"
    return f"{scene.n_objects} objects with {', '.join(scene.goals)} for {scene.instruction!r}"


Told = tuple[Sequence[StepRecord], EpisodeRecord]
"""An episode with its steps."""


def same_episode(a: Told, b: Told) -> bool:
    """Whether two runs of an episode are the same in all but times."""
    return _timeless(a[1]) == _timeless(b[1]) and [_timeless(s) for s in a[0]] == [_timeless(s) for s in b[0]]


def same_results(a: Records, b: Records) -> tuple[str, ...]:
    """Return where two sets of finished episodes differ in anything but times; nothing = the same numbers.

    The order of the records and episodes that are not finished are left out of it.
    """
    return (*only_in_one(a, b), *changed_records(a, b))


def only_in_one(a: Records, b: Records) -> tuple[str, ...]:
    """Return the piles and episodes that only one of two sets holds."""
    found: list[str] = []
    for what, mine, theirs in (("pile", a.scenes, b.scenes), ("episode", a.episodes, b.episodes)):
        for missing, where in ((mine.keys() - theirs.keys(), "first"), (theirs.keys() - mine.keys(), "second")):
            found += [f"{what} {_words(key)} only in the {where}" for key in sorted(missing)]
    return tuple(found)


def changed_records(a: Records, b: Records) -> tuple[str, ...]:
    """Return piles and episodes that two sets hold otherwise, times apart; of each the first difference."""
    found: list[str] = []
    for key in sorted(a.scenes.keys() & b.scenes.keys()):
        found += _changed(f"pile {_words(key)}", a.scenes[key], b.scenes[key])
    for key in sorted(a.episodes.keys() & b.episodes.keys()):
        name = f"episode {_words(key)}"
        mine, theirs = a.steps.get(key, []), b.steps.get(key, [])
        own: list[str] = []
        for one, other in zip(mine, theirs, strict=False):
            own += _changed(f"{name} step {one.step}", one, other)
        own += _changed(name, a.episodes[key], b.episodes[key])
        if len(mine) != len(theirs):
            own.append(f"{name}: {len(mine)} and {len(theirs)} decisions")
        found += own[:1]
    return tuple(found)


def _changed(name: str, a: Record, b: Record) -> list[str]:
    mine, theirs = vars(_timeless(a)), vars(_timeless(b))
    found = [f"{key} {mine[key]!r} and {theirs[key]!r}" for key in mine if mine[key] != theirs[key]]
    return [f"{name}: {', '.join(found)}"] if found else []


def _timeless(record: Record) -> Record:
    """Return a record without its wall times; of an error only its first line, since tracebacks name folders."""
    if isinstance(record, SceneRecord):
        return replace(record, seconds=0.0)
    if isinstance(record, EpisodeRecord):
        error = record.error.splitlines()[0] if record.error else ""
        return replace(record, seconds=0.0, usage=_timeless_usage(record.usage), error=error)
    stages = tuple((stage, 0.0) for stage, _ in record.timings_ms)
    return replace(record, seconds=0.0, timings_ms=stages, usage=_timeless_usage(record.usage))


def _timeless_usage(usage: Usage) -> Usage:
    return replace(usage, latency_s=0.0)


def _words(key: tuple[str | int, ...]) -> str:
    return f"{' '.join(map(str, key[:-1]))} seed {key[-1]}"
