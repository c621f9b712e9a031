"""Where decisions run: in processes that can be ended in the middle of a stage, or in this one, where they cannot.

A worker carries out one job at a time and says which stage it is in. Between stages it looks whether its client has
left. A process that goes on in one stage beyond the stage's limit, or too long after its client left, is killed and
started anew; nothing else can end a numpy or network call.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol, TextIO

from thinkgrasp.config import PipelineConfig, make_pipeline, override
from thinkgrasp.errors import ConfigError, InputError, ThinkGraspError
from thinkgrasp.interfaces import Planner
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.registry import load
from thinkgrasp.server.decoding import TooLarge, without_paths
from thinkgrasp.server.jobs import Answer, Desk, Job
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.logs import to_stream, where_raised

POLL_S = 0.02
MakePipeline = Callable[[], Pipeline]
NewPlanner = Callable[[float], Planner]


class Cancelled(Exception):
    """The client left, so that nobody waits for the answer."""


class Refused(Exception):
    """The job's input cannot be used."""

    def __init__(self, message: str, *, too_large: bool = False) -> None:
        super().__init__(message)
        self.too_large = too_large


class StageTimeout(Exception):
    """A stage took longer than it may."""

    def __init__(self, stage: str, limit_s: float) -> None:
        super().__init__(f"the stage {stage!r} took longer than {limit_s:g} s")
        self.stage = stage


class WorkerFailed(Exception):
    """A bug or a broken plug-in, or the end of the worker's process; `what` may go into a log."""

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self.what = what


class Watch:
    """What a running job is watched by: whether its client left, and which stage it is in since when."""

    def __init__(self, limits: Limits, on_stage: Callable[[str, float], None] = lambda stage, seconds: None) -> None:
        self.left = threading.Event()
        """Set when nobody waits for the answer."""
        self._limits = limits
        self._on_stage = on_stage
        self._start = self._since = time.monotonic()
        self._stage = "decode"

    def enter(self, stage: str) -> None:
        """Note that a stage begins, and report how long the one before took."""
        now = time.monotonic()
        if stage != self._stage:
            self._on_stage(self._stage, now - self._since)
            self._stage, self._since = stage, now

    def check(self) -> None:
        """Raise StageTimeout when the stage, or the whole, takes too long."""
        now, limits = time.monotonic(), self._limits
        for stage, since, limit in (
            (self._stage, self._since, limits.stage_timeout_s(self._stage)),
            ("total", self._start, limits.total_timeout_s),
        ):
            if now - since > limit:
                raise StageTimeout(stage, limit)


class Worker(Protocol):
    """Carries out one job at a time; all calls may block."""

    def start(self) -> None:
        """Load the models; raises ConfigError where they cannot be loaded."""
        ...

    def carry_out(self, job: Job, watch: Watch) -> Answer:
        """Carry a job out; raises Cancelled, Refused, StageTimeout or WorkerFailed."""
        ...

    def is_usable(self) -> bool:
        """Whether it can take another job without being started anew."""
        ...

    def memory_bytes(self) -> int:
        """Resident memory of its process; 0 where it has none of its own, or none that can be read."""
        ...

    def close(self) -> None:
        """End it."""
        ...


@dataclass(frozen=True)
class Recipe:
    """What a worker makes its pipeline from; picklable."""

    config: PipelineConfig
    max_pixels: int
    debug: bool = False
    make: Callable[[PipelineConfig], Pipeline] = make_pipeline

    @property
    def budget_usd(self) -> float | None:
        """What an episode, or a decision by itself, may spend; None = no limit."""
        value = self.config.planner.settings.get("budget_usd")
        return float(value) if isinstance(value, int | float) else None

    def desk(self, announce: Callable[[str], None]) -> Desk:
        """Load the models and return what carries jobs out.

        Raises:
            ThinkGraspError: They cannot be loaded.
        """
        new_planner = self._planner_with if self.budget_usd is not None else None
        return Desk(self.make(self.config), announce, max_pixels=self.max_pixels, new_planner=new_planner)

    def _planner_with(self, budget_usd: float) -> Planner:
        planner = override(self.config, "planner.budget_usd", budget_usd).planner
        return load("planner", planner.name, **planner.settings)


@dataclass(frozen=True)
class _Stage:
    name: str


@dataclass(frozen=True)
class _Ready:
    pass


@dataclass(frozen=True)
class _Unloadable:
    message: str


@dataclass(frozen=True)
class _Failure:
    """An exception as it crosses the pipe."""

    kind: type[Exception]
    message: str

    def as_exception(self) -> Exception:
        if issubclass(self.kind, TooLarge):
            return Refused(self.message, too_large=True)
        if issubclass(self.kind, InputError):
            return Refused(self.message)
        return Cancelled() if issubclass(self.kind, Cancelled) else WorkerFailed(self.message)


def _failure(error: Exception) -> _Failure:
    """Return what may be told of an exception: of bad input all, of a bug its type and where it was raised."""
    if isinstance(error, TooLarge):
        return _Failure(TooLarge, without_paths(str(error)))
    if isinstance(error, InputError):
        return _Failure(InputError, without_paths(str(error)))
    if isinstance(error, Cancelled):
        return _Failure(Cancelled, "")
    return _Failure(WorkerFailed, where_raised(error))


class ProcessWorker:
    """A worker in a process of its own."""

    def __init__(self, recipe: Recipe, limits: Limits) -> None:
        self._recipe = recipe
        self._limits = limits
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._usable = False

    def start(self) -> None:
        """Start the process and wait until its models are loaded.

        Raises:
            ConfigError: They cannot be loaded, or the process ended.
        """
        self.close()
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        process = context.Process(target=_run, args=(theirs, self._recipe), daemon=True)
        process.start()
        theirs.close()
        self._pipe, self._process = pipe, process
        try:
            said = pipe.recv()
        except (EOFError, OSError):
            raise ConfigError("a worker's process ended while it was loading the models") from None
        if isinstance(said, _Unloadable):
            raise ConfigError(said.message)
        self._usable = True

    def carry_out(self, job: Job, watch: Watch) -> Answer:
        """Carry a job out; a process that does not end its stage in time is killed."""
        pipe, deadline = self._pipe, float("inf")
        if pipe is None or not self._usable:
            raise WorkerFailed("the worker is not running")
        try:
            pipe.send(job)
            while True:
                if pipe.poll(POLL_S):
                    said = pipe.recv()
                    if isinstance(said, _Stage):
                        watch.enter(said.name)
                        continue
                    if isinstance(said, _Failure):
                        raise said.as_exception()
                    watch.enter("done")
                    return said
                if watch.left.is_set() and deadline == float("inf"):
                    pipe.send(None)
                    deadline = time.monotonic() + self._limits.cancel_grace_s
                if time.monotonic() > deadline:
                    self.close()
                    raise Cancelled
                watch.check()
        except StageTimeout:
            self.close()
            raise
        except (EOFError, OSError) as error:
            process = self._process
            if process is not None:
                process.join(1)
            code = None if process is None else process.exitcode
            self.close()
            raise WorkerFailed(f"the worker's process ended with code {code}") from error

    def is_usable(self) -> bool:
        """Whether its process runs and waits for a job."""
        process = self._process  # another thread may close the worker meanwhile
        return self._usable and process is not None and process.is_alive()

    def memory_bytes(self) -> int:
        """Resident memory of its process, by Linux's /proc; 0 elsewhere."""
        process = self._process  # as above
        return resident_bytes(process.pid) if process is not None and process.pid else 0

    def close(self) -> None:
        """Kill the process."""
        self._usable = False
        pipe, self._pipe = self._pipe, None
        process, self._process = self._process, None
        if pipe is not None:
            pipe.close()
        if process is not None:
            process.kill()
            process.join(5)


def _run(pipe: Connection, recipe: Recipe) -> None:
    """What a worker's process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the server ends its workers itself
    if recipe.debug:
        _serve(pipe, recipe)
        return
    warnings.simplefilter("ignore")
    with _log_alone() as out, to_stream(out):
        _serve(pipe, recipe)


@contextmanager
def _log_alone() -> Iterator[TextIO]:
    """Keep stderr for the log: what libraries print may name paths, and is no JSON."""
    with os.fdopen(os.dup(2), "w", buffering=1) as out:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        os.close(nowhere)
        yield out


def _serve(pipe: Connection, recipe: Recipe) -> None:
    """Load the models, then carry out jobs until the server has gone."""

    def announce(stage: str) -> None:
        if pipe.poll(0) and pipe.recv() is None:
            raise Cancelled
        pipe.send(_Stage(stage))

    try:
        try:
            desk = recipe.desk(announce)
        except Exception as error:  # a plug-in may fail in any way while it is made
            if recipe.debug:
                traceback.print_exc(file=sys.stderr)
            pipe.send(_Unloadable(str(error) if isinstance(error, ThinkGraspError) else where_raised(error)))
            return
        pipe.send(_Ready())
        while True:
            job = pipe.recv()
            if job is None:
                continue  # its client left just when it was done
            try:
                said = desk.carry_out(job)
            except Exception as error:
                if recipe.debug and not isinstance(error, InputError | Cancelled):
                    traceback.print_exc(file=sys.stderr)
                said = _failure(error)
            pipe.send(said)
    except (EOFError, OSError):
        return  # the server has gone


class InProcessWorker:
    """A worker in the server's own process: a running stage cannot be ended, only not be followed by another."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._desk: Desk | None = None
        self._watch: Watch | None = None

    def start(self) -> None:
        """Load the models.

        Raises:
            ConfigError: They cannot be loaded.
        """
        self._desk = self._recipe.desk(self._announce)

    def carry_out(self, job: Job, watch: Watch) -> Answer:
        """Carry a job out; limits and clients that left are noticed between stages."""
        if self._desk is None:
            raise WorkerFailed("the worker is not running")
        self._watch = watch
        try:
            answer = self._desk.carry_out(job)
        except StageTimeout:
            raise
        except Exception as error:
            if self._recipe.debug and not isinstance(error, InputError | Cancelled):
                traceback.print_exc(file=sys.stderr)
            raise _failure(error).as_exception() from error
        watch.enter("done")
        return answer

    def is_usable(self) -> bool:
        """Always, once started."""
        return self._desk is not None

    def memory_bytes(self) -> int:
        """0: the server's process is counted by itself."""
        return 0

    def close(self) -> None:
        """Forget the models."""
        self._desk = None

    def _announce(self, stage: str) -> None:
        watch = self._watch
        if watch is None:
            return
        watch.check()
        if watch.left.is_set():
            raise Cancelled
        watch.enter(stage)


def resident_bytes(pid: int) -> int:
    """Return a process's resident memory, by Linux's /proc; 0 where that is not known."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmRSS:")), 0)
