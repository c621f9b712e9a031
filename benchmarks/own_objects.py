"""How often an object of one's own is delivered when it is asked for by name among ten catalogue objects.

    python benchmarks/own_objects.py ../shared/objects_ycb [--seeds 5] [--preset offline] [--workers 2]

DIR holds a folder per object with its model.urdf. Every object in turn is asked for as "the <name>"; it alone lies
among the others.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro
from episode_records import EpisodeRecord
from episode_report import report
from episodes import Job, run_scene, size_wh
from trials import run_all

from thinkgrasp.sim.tasks import STEP_LIMIT, task_for
from thinkgrasp.sim.urdf import load_objects

TARGET = 0.80
"""Least share of successes that is aimed for."""
SUITE = "own objects"


@dataclass(frozen=True)
class Settings:
    """What the episodes have in common."""

    folder: Path
    preset: str
    size: tuple[int, int]


def ask_for(settings: Settings, wanted: tuple[str, int]) -> EpisodeRecord:
    """Run the episode of a name and a seed."""
    name, seed = wanted
    scene = task_for(f"the {name}", seed, load_objects(settings.folder))
    return run_scene(scene, STEP_LIMIT["clutter"], Job(name, seed, settings.preset, settings.size), SUITE)


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
        preset: Pipeline.
        size: Of the camera's image.
        workers: Processes.
    """
    wanted = [(obj.name, seed) for obj in load_objects(folder) for seed in range(seeds)]
    records: list[EpisodeRecord] = []
    for record in run_all(partial(ask_for, Settings(folder, preset, size_wh(size))), wanted, workers):
        records.append(record)
        print(f"{record.task} seed {record.seed}: {record.end} after {record.steps}", file=sys.stderr, flush=True)
    print(report(sorted(records, key=lambda r: wanted.index((r.task, r.seed)))))
    print(f"\nTarget: {100 * TARGET:.0f} % of the episodes succeed.")


if __name__ == "__main__":
    tyro.cli(main)
