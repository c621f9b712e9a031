"""Benchmarks without a simulator: a plan of two tasks, and records that depend on nothing but their keys."""

from __future__ import annotations

import time
import zlib
from collections import deque
from collections.abc import Iterator

from thinkgrasp.benchmark.methods import parse_method
from thinkgrasp.benchmark.plan import BenchmarkPlan
from thinkgrasp.benchmark.records import EpisodeKey, EpisodeRecord, Record, SceneRecord, StepRecord
from thinkgrasp.benchmark.runner import Died, Group
from thinkgrasp.benchmark.suites import SuiteSource
from thinkgrasp.sim.options import CameraOptions
from thinkgrasp.types import Usage

TASKS = ("clutter-06-fruit", "clutter-09-pear")


def small_plan(methods: tuple[str, ...] = ("offline", "oracle"), runs: int = 3) -> BenchmarkPlan:
    return BenchmarkPlan(
        SuiteSource("clutter-v1"), TASKS, 1000, runs, CameraOptions(), tuple(parse_method(m) for m in methods)
    )


def scene(task: str, seed: int) -> SceneRecord:
    return SceneRecord(task, seed, "give me that", ("pear",), (0.5,), 9, fewest=1, is_fewest_exact=True)


def episode(key: EpisodeKey) -> list[StepRecord | EpisodeRecord]:
    """Return an episode of 1 to 4 steps, of which the last one delivers the goal three times in four."""
    number = zlib.crc32(" ".join(map(str, key)).encode())
    n, success = 1 + number % 4, number // 4 % 4 > 0
    steps: list[StepRecord | EpisodeRecord] = [
        StepRecord(
            *key, step, "grasp", "goal", "pear", "pear" if step == n else "mug", step == n, True, True,
            is_right=step == n, chance=0.25, reason="held" if step < n or success else "slipped",
            touched="", delivered="", is_goal_touched=False, is_goal_delivered=step == n and success,
            moved_out=(), toppled=(), degraded=(), timings_ms=(("total", 1.0),), seconds=0.1, usage=Usage(),
        )
        for step in range(1, n + 1)
    ]  # fmt: skip
    return [*steps, EpisodeRecord(*key, success, "goal_delivered" if success else "step_limit", n)]


def fake_source(plan: BenchmarkPlan, groups: deque[Group], delay_s: float = 0.0) -> Iterator[Record | Died]:
    """Run groups one after the other."""
    while groups:
        group = groups.popleft()
        if group.needs_scene:
            yield scene(group.task, group.seed)
        for method in group.methods:
            for record in episode(group.key(method)):
                time.sleep(delay_s)
                yield record
