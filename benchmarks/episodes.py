"""How often the closed loop delivers what was asked for, over every task of the simulated cell and many piles.

    python benchmarks/episodes.py --suite clutter --preset oracle offline --seeds 10 --out episodes.jsonl
    python benchmarks/episodes.py --tasks pear heavy-04-fruit --seeds 3

Every finished episode is one line of --out at once; the same command on the same file goes on where it was interrupted,
and prints the report over all that it asked for. Results do not depend on the number of workers; times do: take those
from a run with one. The preset `oracle` knows names and masks from the simulator: an upper bound.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from episode_records import SCHEMA, EpisodeRecord, Look, RecordLog, Tried
from episode_report import report
from trials import run_all

from thinkgrasp.errors import ConfigError, ThinkGraspError
from thinkgrasp.loop import Step
from thinkgrasp.sim.scenes import PiledScene
from thinkgrasp.sim.tasks import TASKS, Task, find_task
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.testbed import Attempt, CameraOptions, Session
from thinkgrasp.types import Decision, Outcome

IN_VIEW_SHARE = 1 / 4000
"""A goal is in view where it fills this share of the image: 77 pixels of 640x480, 12 of 224x224."""


@dataclass(frozen=True)
class Job:
    """One episode to run."""

    task: str
    seed: int
    preset: str
    size: tuple[int, int]

    @property
    def key(self) -> tuple[str, int, str, tuple[int, int]]:
        """As `EpisodeRecord.key`."""
        return self.task, self.seed, self.preset, self.size


class Observer:
    """Ties every decision to the truth: before each step it notes what every pixel shows."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._labels: list[np.ndarray] = []
        self.looks: list[Look] = []

    def look(self) -> bool:
        """To be asked before every step; the episode goes on."""
        self._labels = [true_labels(self._session.world, view) for view in self._session.views]
        return False

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Note what a decision was truly about."""
        frame = decision.scene.frame
        labels = next(
            labels
            for view, labels in zip(self._session.views, self._labels, strict=True)
            if frame.T_world_camera is not None and np.array_equal(view.T_world_camera, frame.T_world_camera)
        )
        goals = self._session.goals
        of_target = labels[decision.target.mask] if decision.target is not None else labels[:0].ravel()
        of_target = of_target[of_target >= 0]
        aimed = int(np.bincount(of_target).argmax()) if len(of_target) else None
        seen = max(int(np.count_nonzero(labels == goal)) for goal in goals)
        self.looks.append(
            Look(
                status=decision.status,
                target=decision.plan.target,
                role=decision.plan.role,
                aimed=_name(self._session, aimed),
                is_goal_aimed=aimed in goals,
                is_goal_in_view=seen >= IN_VIEW_SHARE * labels.size,
                decision_ms=dict(decision.timings_ms)["total"],
            )
        )


def run_job(job: Job) -> EpisodeRecord:
    """Run one episode of a task; what goes wrong is part of the record."""
    task = find_task(job.task)
    try:
        scene = task.scene(job.seed)
    except ThinkGraspError as error:
        return _not_run(job, task, "no_scene", str(error))
    try:
        return run_scene(scene, task.step_limit, job, task.suite)
    except Exception as error:  # one crash must not end a night of episodes; it is counted and shown
        traceback.print_exc()
        return _not_run(job, task, "crashed", f"{type(error).__name__}: {error}")


def run_scene(scene: PiledScene, step_limit: int, job: Job, suite: str) -> EpisodeRecord:
    """Run one episode over a pile."""
    start = time.perf_counter()
    session = Session(scene, CameraOptions(size_wh=job.size), seed=job.seed)
    observer = Observer(session)
    run = session.run(
        session.pipeline(job.preset), step_limit=step_limit, recorders=[observer], stop=observer.look
    )  # fmt: skip
    world, episode = session.world, run.episode
    executed = [(look, step) for look, step in zip(observer.looks, episode.steps, strict=True) if step.outcome]
    attempts = tuple(
        _tried(session, look, step, attempt) for (look, step), attempt in zip(executed, run.attempts, strict=True)
    )
    return EpisodeRecord(
        SCHEMA,
        suite,
        job.task,
        job.seed,
        job.preset,
        job.size,
        episode.instruction,
        goals=tuple(world.objects[goal].name for goal in run.goals),
        visible=tuple(round(share, 4) for share in scene.visible_fractions),
        n_objects=len(world.objects),
        success=episode.success,
        end=episode.end,
        steps=episode.attempts,
        attempts=attempts,
        unanswered=observer.looks[-1] if len(executed) < len(observer.looks) else None,
        lost=tuple(name for tried in attempts for name in tried.moved_out),
        goals_lost=sum(not world.on_table(goal) and not world.in_bin(goal) for goal in run.goals),
        seconds=round(time.perf_counter() - start, 3),
    )


def _tried(session: Session, look: Look, step: Step, attempt: Attempt) -> Tried:
    touched, delivered = attempt.truth.touched, attempt.truth.delivered
    outcome = step.outcome or attempt.outcome
    return Tried(
        look,
        reason=outcome.reason,
        touched=_name(session, touched),
        delivered=_name(session, delivered),
        is_goal_touched=touched in session.goals,
        is_goal_delivered=delivered in session.goals,
        moved_out=tuple(session.world.objects[i].name for i in attempt.moved_out),
        seconds=round(step.duration_s - look.decision_ms / 1e3, 4),
    )


def _name(session: Session, index: int | None) -> str:
    return "" if index is None else session.world.objects[index].name


def _not_run(job: Job, task: Task, end: str, error: str) -> EpisodeRecord:
    return EpisodeRecord(
        SCHEMA, task.suite, job.task, job.seed, job.preset, job.size, task.instruction,
        (), (), 0, False, end, 0, (), None, (), 0, 0.0, error,
    )  # fmt: skip


def run_jobs(jobs: Sequence[Job], workers: int, out: Path | None) -> list[EpisodeRecord]:
    """Run what the file does not have yet; return the records of all jobs, in their order."""
    log = RecordLog(out, EpisodeRecord)
    done = {record.key for record in log.records}
    missing = [job for job in jobs if job.key not in done]
    for n, record in enumerate(run_all(run_job, missing, workers), 1):
        log.add(record)
        print(
            f"{n}/{len(missing)} {record.task} seed {record.seed} {record.preset}: {record.end} "
            f"after {record.steps}, {record.seconds:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    found = {record.key: record for record in log.records}
    return [found[job.key] for job in jobs]


def size_wh(text: str) -> tuple[int, int]:
    """Read "640x480".

    Raises:
        ConfigError: It is no size.
    """
    sides = text.split("x")
    if len(sides) != 2 or not all(side.isdecimal() for side in sides):
        raise ConfigError(f"--size must be WIDTHxHEIGHT, for example 640x480, got {text!r}")
    return int(sides[0]), int(sides[1])


def main(
    suite: Literal["clutter", "heavy", "all"] = "all",
    preset: tuple[str, ...] = ("oracle", "offline"),
    seeds: int = 10,
    first_seed: int = 0,
    tasks: tuple[str, ...] = (),
    workers: int = 2,
    size: str = "640x480",
    out: Path | None = None,
) -> None:
    """Run the episodes and print the report.

    Args:
        suite: Which tasks; not asked where tasks are named.
        preset: Pipelines to compare.
        seeds: Piles per task.
        first_seed: Of the first pile.
        tasks: Names of tasks, or endings of them.
        workers: Processes.
        size: Of the camera's image.
        out: JSON lines, one per finished episode.
    """
    chosen = [find_task(name) for name in tasks] or [t for t in TASKS if suite in ("all", t.suite)]
    jobs = [
        Job(task.name, seed, name, size_wh(size))
        for name in preset
        for task in chosen
        for seed in range(first_seed, first_seed + seeds)
    ]
    print(report(run_jobs(jobs, workers, out)))


if __name__ == "__main__":
    tyro.cli(main)
