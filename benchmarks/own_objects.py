"""How often an object of one's own is delivered when it is asked for by name among ten catalogue objects.

    python benchmarks/own_objects.py ../shared/objects_ycb [--seeds 5] [--preset offline] [--workers 2]

DIR holds a folder per object with its model.urdf. Every object in turn is asked for as "the <name>"; it alone lies
among the others.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from trials import rate, run_all

from thinkgrasp.benchmark.failures import counted
from thinkgrasp.benchmark.methods import parse_method
from thinkgrasp.benchmark.records import EpisodeRecord, Record
from thinkgrasp.benchmark.suites import Case
from thinkgrasp.benchmark.trial import run_trial
from thinkgrasp.sim.options import CameraOptions, parse_size
from thinkgrasp.sim.tasks import STEP_LIMIT, task_for
from thinkgrasp.sim.urdf import load_objects

TARGET = 0.80
"""Least share of successes that is aimed for."""


@dataclass(frozen=True)
class Settings:
    """What the episodes have in common."""

    folder: Path
    preset: str
    size: tuple[int, int]


def ask_for(settings: Settings, wanted: tuple[str, int]) -> EpisodeRecord:
    """Run the episode of a name and a seed."""
    name, seed = wanted
    own = load_objects(settings.folder)
    case = Case(name, f"the {name}", STEP_LIMIT["clutter"], partial(task_for, f"the {name}", own=own))
    records: list[Record] = []
    camera = CameraOptions(size_wh=settings.size)
    run_trial(parse_method(settings.preset), case, case.scene(seed), seed, camera, records.append)
    return next(record for record in records if isinstance(record, EpisodeRecord))


def report(records: Sequence[EpisodeRecord]) -> str:
    """Return a table in Markdown, one row per object."""
    lines = ["| object | success (95 %) | grasps | ends |", "|---|---|---|---|"]
    for name in (*dict.fromkeys(record.task for record in records), "all"):
        of_name = [record for record in records if name in (record.task, "all")]
        lines.append(
            f"| {name} | {rate(sum(record.success for record in of_name), len(of_name))} "
            f"| {np.mean([record.steps for record in of_name]):.2f} | {counted(record.end for record in of_name)} |"
        )
    return "\n".join(lines)


def main(
    folder: tyro.conf.Positional[Path],
    seeds: int = 5,
    preset: str = "offline",
    size: str = "640x480",
    workers: int = 2,
) -> None:
    """Run the episodes and print the report.

    Args:
        folder: Holds the objects' folders.
        seeds: Piles per object.
        preset: Method, as for `thinkgrasp bench run`.
        size: Of the camera's image.
        workers: Processes.
    """
    wanted = [(obj.name, seed) for obj in load_objects(folder) for seed in range(seeds)]
    records: list[EpisodeRecord] = []
    for record in run_all(partial(ask_for, Settings(folder, preset, parse_size(size))), wanted, workers):
        records.append(record)
        print(f"{record.task} seed {record.seed}: {record.end} after {record.steps}", file=sys.stderr, flush=True)
    print(report(sorted(records, key=lambda r: wanted.index((r.task, r.seed)))))
    print(f"\nTarget: {100 * TARGET:.0f} % of the episodes succeed.")


if __name__ == "__main__":
    tyro.cli(main)
