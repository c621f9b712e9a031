"""How success in clutter depends on how good the vision-language model is, measured with the emulator of one.

    python benchmarks/vlm_quality.py --episodes 30 --out vlm_quality.jsonl --plot-to docs/pictures/vlm_quality.svg
    python benchmarks/vlm_quality.py --presets no-vlm no-grid grid-2 grid-3 grid-4 vlm-crop vlm-only --accuracy 1 \
        --episodes 30 --out vlm_ablations.jsonl

No model is asked: a local server answers from the simulator's truth, and is right as often as --accuracy says. Episode
n is task n % 10 of the clutter suite with seed n // 10, the same piles for every preset and accuracy. Every finished
episode is one line of --out at once; the same command on the same file goes on where it was interrupted. Tokens are
the emulator's, which are made up after one model's published rules.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import tyro
from pydantic import TypeAdapter
from quality_plot import Curve, plot
from trials import rate, run_all, wilson

from thinkgrasp.benchmark.chat import MODEL
from thinkgrasp.benchmark.emulator import Quality, VlmEmulator
from thinkgrasp.config import PipelineConfig, load_config, override
from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.sim.tasks import TASKS, find_task
from thinkgrasp.testbed import CameraOptions, Session

CLUTTER = tuple(task.name for task in TASKS if task.suite == "clutter")


@dataclass(frozen=True)
class Job:
    """One episode to run."""

    preset: str
    accuracy: float
    episode: int

    @property
    def task(self) -> str:
        """Name of the task."""
        return CLUTTER[self.episode % len(CLUTTER)]

    @property
    def seed(self) -> int:
        """Of the pile."""
        return self.episode // len(CLUTTER)


@dataclass(frozen=True)
class QualityRecord:
    """A finished episode."""

    job: Job
    end: str
    """Named reason; "no_scene" or "crashed" where there was no episode, or no end of it."""
    steps: int = 0
    """Executed grasps."""
    replies_right: int = 0
    replies_wrong: int = 0
    requests: int = 0
    """Those for decisions that were not acted upon included."""
    prompt_tokens: int = 0
    completion_tokens: int = 0
    degraded: int = 0
    """Steps that were planned in another way than by the model's reply."""
    seconds: float = 0.0
    error: str = ""

    @property
    def success(self) -> bool:
        """Whether a goal was delivered."""
        return self.end == "goal_delivered"


_RECORD = TypeAdapter(QualityRecord)


def config(preset: str, base_url: str) -> PipelineConfig:
    """Return a preset that asks this server if it asks any."""
    chosen = load_config(preset)
    if chosen.planner.name != "openai":
        return chosen
    return override(override(chosen, "planner.model", MODEL), "planner.base_url", base_url)


def grid(chosen: PipelineConfig) -> int:
    """Return the cells per side that a configuration's planner speaks of."""
    return cast(int, chosen.planner.settings.get("grid", 3))


def run_job(job: Job) -> QualityRecord:
    """Run one episode; what goes wrong is part of the record."""
    task, start = find_task(job.task), time.perf_counter()
    try:
        scene = task.scene(job.seed)
    except ThinkGraspError as error:
        return QualityRecord(job, "no_scene", error=str(error))
    session = Session(scene, CameraOptions(), seed=job.seed)
    quality, cells = Quality(accuracy=job.accuracy), grid(load_config(job.preset))
    with VlmEmulator(session, quality, grid=cells, seed=job.episode) as emulator:
        try:
            pipeline = session.pipeline(config(job.preset, emulator.base_url))
            episode = session.run(pipeline, step_limit=task.step_limit).episode
        except Exception as error:  # one crash must not end a night of episodes; it is counted and shown
            traceback.print_exc()
            return QualityRecord(job, "crashed", error=f"{type(error).__name__}: {error}")
    served = emulator.served
    return QualityRecord(
        job,
        episode.end,
        steps=episode.attempts,
        replies_right=sum(s.kind == "right" for s in served),
        replies_wrong=sum(s.kind == "wrong" for s in served),
        requests=len(served),
        prompt_tokens=sum(s.prompt_tokens for s in served),
        completion_tokens=sum(s.completion_tokens for s in served),
        degraded=sum(any(d.stage == "plan" for d in step.decision.plan.degraded) for step in episode.steps),
        seconds=round(time.perf_counter() - start, 3),
    )


def run_jobs(jobs: Sequence[Job], workers: int, out: Path | None) -> list[QualityRecord]:
    """Run what the file does not have yet; return the records of all jobs, in their order."""
    found = {record.job: record for record in _read(out)}
    missing = [job for job in jobs if job not in found]
    for n, record in enumerate(run_all(run_job, missing, workers), 1):
        found[record.job] = record
        if out is not None:
            with out.open("ab") as file:
                file.write(_RECORD.dump_json(record) + b"\n")
                file.flush()
                os.fsync(file.fileno())
        job = record.job
        print(
            f"{n}/{len(missing)} {job.preset} {job.accuracy} {job.task} seed {job.seed}: {record.end} after "
            f"{record.steps}, {record.requests} requests, {record.seconds:.0f} s {record.error}",
            file=sys.stderr,
            flush=True,
        )
    return [found[job] for job in jobs]


def _read(out: Path | None) -> list[QualityRecord]:
    """Return what a file holds; a torn last line is cut off."""
    if out is None or not out.exists():
        return []
    content = out.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(out, len(whole))
    return [_RECORD.validate_json(line) for line in whole.splitlines()]


def report(records: Sequence[QualityRecord]) -> str:
    """Return a table in Markdown, one row per preset and accuracy."""
    lines = [
        "| preset | accuracy | success | grasps | requests | tokens in + out | right replies | degraded steps | ends |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (preset, accuracy), group in _groups(records).items():
        right, wrong = (sum(getattr(r, f"replies_{kind}") for r in group) for kind in ("right", "wrong"))
        ends = {end: sum(r.end == end for r in group) for end in sorted({r.end for r in group})}
        lines.append(
            f"| {preset} | {accuracy:g} | {rate(sum(r.success for r in group), len(group))} "
            f"| {_mean(group, 'steps'):.1f} | {_mean(group, 'requests'):.1f} "
            f"| {_mean(group, 'prompt_tokens'):.0f} + {_mean(group, 'completion_tokens'):.0f} "
            f"| {right}/{right + wrong} | {sum(r.degraded for r in group)} "
            f"| {', '.join(f'{end} {n}' for end, n in ends.items())} |"
        )
    return "\n".join(lines)


def curves(records: Sequence[QualityRecord]) -> list[Curve]:
    """Return success with its interval over accuracy, one curve per preset."""
    groups = _groups(records)
    return [
        Curve(
            preset,
            tuple(
                (accuracy, good / len(group), *wilson(good, len(group)))
                for (of, accuracy), group in sorted(groups.items())
                if of == preset
                for good in [sum(r.success for r in group)]
            ),
        )
        for preset in dict.fromkeys(preset for preset, _ in groups)
    ]


def _groups(records: Sequence[QualityRecord]) -> dict[tuple[str, float], list[QualityRecord]]:
    groups: dict[tuple[str, float], list[QualityRecord]] = {}
    for record in records:
        groups.setdefault((record.job.preset, record.job.accuracy), []).append(record)
    return groups


def _mean(records: Sequence[QualityRecord], what: str) -> float:
    return float(np.mean([getattr(r, what) for r in records]))


def main(
    presets: tuple[str, ...] = ("vlm", "vlm-paper"),
    accuracy: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.0),
    episodes: int = 30,
    workers: int = 2,
    out: Path | None = None,
    plot_to: Path | None = None,
) -> None:
    """Run the episodes, print the table, draw the plot.

    Args:
        presets: What runs; see `thinkgrasp presets`.
        accuracy: Probabilities that the emulated model names the right thing.
        episodes: Per preset and accuracy.
        workers: Processes.
        out: JSON lines, one per finished episode.
        plot_to: An SVG file.
    """
    for preset in presets:
        load_config(preset)
    jobs = [Job(preset, p, n) for preset in presets for p in accuracy for n in range(episodes)]
    records = run_jobs(jobs, workers, out)
    print(report(records))
    if plot_to is not None:
        title = f"Success in clutter, {episodes} episodes per point (95 % intervals)"
        plot_to.write_text(plot(curves(records), title, "how often the emulated model names the right thing"))


if __name__ == "__main__":
    tyro.cli(main)
