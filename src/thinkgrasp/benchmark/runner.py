"""Run a benchmark: every method over every pile, on a few processes, going on wherever it was cut off.

One process writes; the others run groups of episodes over one pile each and send every record as it comes. A process
that dies costs the episode that it was running, which is started anew once.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from thinkgrasp.benchmark.fewest_steps import fewest_steps
from thinkgrasp.benchmark.methods import Method, check_methods
from thinkgrasp.benchmark.plan import PLAN_FILE, BenchmarkPlan, read_plan
from thinkgrasp.benchmark.records import (
    CRASHED,
    NO_SCENE,
    EpisodeKey,
    EpisodeRecord,
    Record,
    RecordLog,
    Records,
    SceneKey,
    SceneRecord,
)
from thinkgrasp.benchmark.suites import Case, SuiteSource, load_suite
from thinkgrasp.benchmark.trial import run_trial
from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.sim.scenes import PiledScene

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""One thread for linear algebra, so that sums are the same for any number of workers."""
MAX_STARTS = 2
"""So often an episode is started whose process dies."""


@dataclass(frozen=True)
class Group:
    """Episodes over one pile that one process runs one after the other."""

    task: str
    seed: int
    methods: tuple[str, ...]
    needs_scene: bool
    """Whether the pile's own record is missing."""

    def key(self, method: str) -> EpisodeKey:
        """Of one of its episodes."""
        return EpisodeKey(method, self.task, self.seed)


@dataclass(frozen=True)
class Died:
    """A process ended without having finished its group."""

    group: Group
    """What is left of it, the episode that was running first."""
    why: str


Source = Callable[[BenchmarkPlan, "deque[Group]"], Iterator[Record | Died]]
"""Runs groups, which may be added to while it does, and yields what comes of them; the call itself raises ConfigError
where a method cannot run there."""


def missing_groups(plan: BenchmarkPlan, records: Records) -> list[Group]:
    """Return what is left to run: seed by seed, so that a part of it already compares all methods and tasks."""
    groups: list[Group] = []
    for seed in plan.seeds:
        for task in plan.tasks:
            missing = [m.name for m in plan.methods if EpisodeKey(m.name, task, seed) not in records.episodes]
            needs_scene = SceneKey(task, seed) not in records.scenes
            if missing or needs_scene:
                groups.append(Group(task, seed, tuple(missing), needs_scene))
    return groups


def take_group(groups: deque[Group], workers: int) -> Group:
    """Take the next group; of the last ones half, so that no worker runs all methods of a pile while others idle."""
    group = groups.popleft()
    half = (len(group.methods) + 1) // 2
    if len(groups) < workers - 1 and half < len(group.methods):
        groups.append(replace(group, methods=group.methods[half:], needs_scene=False))
        return replace(group, methods=group.methods[:half])
    return group


def methods_of(plan: BenchmarkPlan, groups: Iterable[Group]) -> tuple[Method, ...]:
    """Return the methods that groups run."""
    names = {name for group in groups for name in group.methods}
    return tuple(method for method in plan.methods if method.name in names)


def run_benchmark(
    plan: BenchmarkPlan,
    folder: Path,
    source: Source,
    tell: Callable[[str], None],
    *,
    retry_crashed: bool = False,
) -> Records:
    """Run what a folder does not hold yet.

    Args:
        plan: What to run, besides what the folder's own plan says.
        folder: Gets benchmark.json and records.jsonl.
        source: Where it runs: `local_workers` or `ray_workers`.
        tell: Gets one line of progress per episode.
        retry_crashed: Run those again that crashed or had no pile.

    Raises:
        ConfigError: A method cannot run here; another process writes to the folder, or it holds results of other piles
            or other methods.
        InputError: The folder cannot be used, or holds what is no benchmark.
    """
    with RecordLog(folder, drop=lambda episode: retry_crashed and episode.end in (CRASHED, NO_SCENE)) as log:
        if (folder / PLAN_FILE).exists():
            plan = read_plan(folder).merged(plan)
        groups = deque(missing_groups(plan, log.records))
        found = source(plan, groups)
        plan.started().write(folder)
        progress = _Progress(sum(len(group.methods) for group in groups), tell)
        starts: dict[EpisodeKey, int] = {}
        for record in found:
            if not isinstance(record, Died):
                log.add(record)
                if isinstance(record, EpisodeRecord):
                    progress.finished(record)
                continue
            rest = record.group
            if rest.methods:
                key = rest.key(rest.methods[0])
                log.forget(key)
                starts[key] = starts.get(key, 1) + 1
                if starts[key] > MAX_STARTS:
                    lost = EpisodeRecord(*key, success=False, end=CRASHED, steps=0, error=record.why)
                    log.add(lost)
                    progress.finished(lost)
                    rest = replace(rest, methods=rest.methods[1:])
            if rest.methods or rest.needs_scene:
                tell(f"{rest.task} seed {rest.seed}: {record.why}; going on in another process")
                groups.append(rest)
        return log.records


class _Progress:
    """Says how far it is, and how long it will take."""

    def __init__(self, total: int, tell: Callable[[str], None]) -> None:
        self._total, self._tell = total, tell
        self._done = 0
        self._start = time.monotonic()

    def finished(self, record: EpisodeRecord) -> None:
        self._done += 1
        left = (time.monotonic() - self._start) / self._done * (self._total - self._done)
        what = f"{record.method} {record.task} seed {record.seed}: {record.end} after {record.steps}"
        error = f" ({record.error.splitlines()[0]})" if record.error else ""
        self._tell(f"{self._done}/{self._total} {what}, {record.seconds:.0f} s{error}; about {_duration(left)} left")


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def run_group(plan: BenchmarkPlan, group: Group, emit: Callable[[Record], None]) -> None:
    """Make a pile and run methods over it; what goes wrong in an episode is recorded and ends that one alone."""
    case = _cases(plan.source)[group.task]
    start = time.perf_counter()
    try:
        scene = _scene(plan.source, group.task, group.seed)
    except ThinkGraspError as error:
        if group.needs_scene:
            emit(SceneRecord(group.task, group.seed, case.instruction, error=str(error)))
        for name in group.methods:
            emit(EpisodeRecord(*group.key(name), success=False, end=NO_SCENE, steps=0, error=str(error)))
        return
    if group.needs_scene:
        fewest = fewest_steps(scene)
        emit(
            SceneRecord(
                group.task,
                group.seed,
                case.instruction,
                goals=tuple(scene.spec.objects[goal].name for goal in scene.spec.goals),
                visible=tuple(round(share, 4) for share in scene.visible_fractions),
                n_objects=len(scene.spec.objects),
                fewest=fewest.steps,
                is_fewest_exact=fewest.exact,
                seconds=round(time.perf_counter() - start, 3),
            )
        )
    methods = {method.name: method for method in plan.methods}
    for name in group.methods:
        start = time.perf_counter()
        try:
            run_trial(methods[name], case, scene, group.seed, plan.camera, emit)
        except Exception as error:  # one crash must not end a night of episodes; it is counted and shown
            text = "".join(traceback.format_exception(error))
            seconds = round(time.perf_counter() - start, 3)
            message = f"{type(error).__name__}: {error}\n{text}"
            emit(EpisodeRecord(*group.key(name), False, CRASHED, 0, seconds=seconds, error=message))


@lru_cache(maxsize=2)
def _cases(source: SuiteSource) -> dict[str, Case]:
    return {case.name: case for case in load_suite(source)}


@lru_cache(maxsize=1)
def _scene(source: SuiteSource, task: str, seed: int) -> PiledScene:
    return _cases(source)[task].scene(seed)


def local_workers(n: int) -> Source:
    """Return a source of that many processes of this machine."""

    def run(plan: BenchmarkPlan, groups: deque[Group]) -> Iterator[Record | Died]:
        for variable in THREAD_VARIABLES:
            os.environ[variable] = "1"
        check_methods(methods_of(plan, groups))
        return records(plan, groups)

    def records(plan: BenchmarkPlan, groups: deque[Group]) -> Iterator[Record | Died]:
        workers: dict[Connection, _Worker] = {}
        try:
            while groups or workers:
                while groups and len(workers) < n:
                    worker = _Worker(plan, take_group(groups, n))
                    workers[worker.connection] = worker
                for ready in wait(list(workers)):
                    worker = workers[ready]  # pyright: ignore
                    said = worker.hear()
                    if said is None:
                        if not groups:
                            del workers[ready]  # pyright: ignore
                            worker.stop()
                        else:
                            worker.start(take_group(groups, n))
                        continue
                    if isinstance(said, Died):
                        del workers[ready]  # pyright: ignore
                    yield said
        finally:
            for worker in workers.values():
                worker.kill()

    return run


class _Worker:
    """A process that runs one group after another."""

    def __init__(self, plan: BenchmarkPlan, group: Group) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.connection, theirs = spawn.Pipe()
        self._process: BaseProcess = spawn.Process(target=_serve, args=(theirs, plan), daemon=True)
        self._process.start()
        theirs.close()
        self.start(group)

    def start(self, group: Group) -> None:
        """Give it a group to run."""
        self._group = group
        with contextlib.suppress(ConnectionError):  # it died: the next `hear` says so
            self.connection.send(group)

    def hear(self) -> Record | Died | None:
        """Return what it says: a record, None when the group is finished, or that it died."""
        try:
            said: Record | None = self.connection.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            self.connection.close()
            return Died(self._group, f"its process ended with exit code {self._process.exitcode}")
        if isinstance(said, SceneRecord):
            self._group = replace(self._group, needs_scene=False)
        elif isinstance(said, EpisodeRecord):
            self._group = replace(self._group, methods=self._group.methods[1:])
        return said

    def stop(self) -> None:
        """Let it end."""
        with contextlib.suppress(ConnectionError):
            self.connection.send(None)
        self._process.join()
        self.connection.close()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()


def _serve(connection: Connection, plan: BenchmarkPlan) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while (group := connection.recv()) is not None:
        run_group(plan, group, connection.send)
        connection.send(None)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
