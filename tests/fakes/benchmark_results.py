"""Made-up result folders of a benchmark, for what reads them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from thinkgrasp.benchmark.methods import parse_method
from thinkgrasp.benchmark.plan import BenchmarkPlan, Session, Versions
from thinkgrasp.benchmark.records import RECORDS_FILE, EpisodeRecord, Record, SceneRecord, StepRecord
from thinkgrasp.benchmark.suites import SuiteSource
from thinkgrasp.sim.options import CameraOptions
from thinkgrasp.types import Usage

TASKS = ("clutter-06-fruit", "clutter-09-pear")


def scene(task: str = TASKS[0], seed: int = 1000, **changes) -> SceneRecord:
    given = {"goals": ("apple",), "visible": (0.5,), "n_objects": 9, "fewest": 1, "is_fewest_exact": True}
    return SceneRecord(task, seed, "I need a fruit", **{**given, **changes})


def step(number: int = 1, method: str = "offline", task: str = TASKS[0], seed: int = 1000, **changes) -> StepRecord:
    """A grasp on the goal that held."""
    given = {
        "status": "grasp", "role": "goal", "target": "apple", "aimed": "apple", "is_goal_aimed": True,
        "is_goal_in_view": True, "is_goal_takeable": True, "is_right": True, "chance": 0.25, "reason": "held",
        "touched": "apple", "delivered": "apple", "is_goal_touched": True, "is_goal_delivered": True, "moved_out": (),
        "toppled": (), "degraded": (), "timings_ms": (("scene", 10.0), ("total", 20.0)), "seconds": 0.5,
        "usage": Usage(),
    }  # fmt: skip
    return StepRecord(method, task, seed, number, **{**given, **changes})


MISSED = {"reason": "missed", "touched": "", "delivered": "", "is_goal_touched": False, "is_goal_delivered": False}
OTHER = {
    "role": "obstruction", "target": "box", "aimed": "box", "is_goal_aimed": False, "touched": "box",
    "delivered": "box", "is_goal_touched": False, "is_goal_delivered": False,
}  # fmt: skip


def episode(
    steps: int, success: bool = True, method: str = "offline", task: str = TASKS[0], seed: int = 1000, **changes
):
    """Yield the records of an episode: misses, then the goal where it succeeds."""
    for number in range(1, steps + 1):
        last = success and number == steps
        yield step(number, method, task, seed, **({} if last else MISSED))
    end = "goal_delivered" if success else "step_limit"
    yield EpisodeRecord(method, task, seed, success, **{"end": end, "steps": steps, **changes})


def plan(
    methods: Sequence[str] = ("offline",), runs: int = 2, tasks: Sequence[str] = TASKS, suite: str = "clutter-v1",
    source: str = "0123456789ab", first_seed: int = 1000,
) -> BenchmarkPlan:  # fmt: skip
    versions = Versions(
        thinkgrasp="0.1", source=source, python="3.11.2", machine="Linux x86_64", packages={"numpy": "2.0"}
    )
    session = Session(started=datetime(2026, 1, 2, 3, 4, tzinfo=UTC), versions=versions)
    return BenchmarkPlan(
        SuiteSource(suite),
        tuple(tasks),
        first_seed,
        runs,
        CameraOptions(),
        tuple(map(parse_method, methods)),
        (session,),
    )


def write(folder: Path, of: BenchmarkPlan, records: Iterable[Record]) -> Path:
    """Write a result folder as the runner leaves it."""
    folder.mkdir(parents=True, exist_ok=True)
    of.write(folder)
    adapter = TypeAdapter(Record)
    (folder / RECORDS_FILE).write_bytes(b"".join(adapter.dump_json(record) + b"\n" for record in records))
    return folder


def made_up(of: BenchmarkPlan, rates: dict[str, float], seed: int = 0) -> list[Record]:
    """Return a full set of records whose methods succeed about so often."""
    rng = np.random.default_rng(seed)
    records: list[Record] = [
        scene(task, n, fewest=1 + n % 3, is_fewest_exact=n % 4 > 0) for task in of.tasks for n in of.seeds
    ]
    for method, rate in rates.items():
        for task in of.tasks:
            for n in of.seeds:
                records += _random_episode(rng, rate, method, task, n)
    return records


def _random_episode(rng: np.random.Generator, rate: float, method: str, task: str, seed: int) -> list[Record]:
    success, steps = bool(rng.random() < rate), int(rng.integers(1, 6))
    records: list[Record] = []
    usage = Usage("gpt-4o", 1000, 60, 0.0031, 1, 1.2) if "@" in method or method == "vlm" else Usage()
    for number in range(1, steps + 1):
        last = success and number == steps
        kind = {} if last else (MISSED, OTHER, {**OTHER, "role": "goal"})[int(rng.integers(3))]
        times = tuple(
            (stage, round(float(ms), 2)) for stage, ms in zip(
                ("scene", "plan", "segment", "generate", "check", "select", "total"), rng.gamma(4, 10, 7), strict=True
            )
        )  # fmt: skip
        extra = {
            "is_right": last or bool(rng.random() < 0.7), "timings_ms": times, "usage": usage,
            "toppled": ("cup",) if rng.random() < 0.1 else (), "moved_out": ("can",) if rng.random() < 0.05 else (),
            "degraded": ("plan: offline",) if usage.requests and rng.random() < 0.1 else (),
            "is_goal_in_view": bool(rng.random() < 0.8) or last,
        }  # fmt: skip
        records.append(step(number, method, task, seed, **{**kind, **extra}))
    end = "goal_delivered" if success else ("step_limit", "nothing_left", "no_grasp")[int(rng.integers(3))]
    total = sum((usage for _ in range(steps)), Usage())
    records.append(EpisodeRecord(method, task, seed, success, end, steps, usage=total, seconds=3.0))
    return records
