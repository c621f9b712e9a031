from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import time
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.benchmark import episode, fake_source, scene, small_plan

from thinkgrasp.benchmark.plan import read_plan
from thinkgrasp.benchmark.records import (
    CRASHED,
    NO_SCENE,
    EpisodeKey,
    EpisodeRecord,
    Records,
    SceneRecord,
    StepRecord,
    read_records,
)
from thinkgrasp.benchmark.runner import Died, Group, local_workers, missing_groups, run_benchmark, take_group
from thinkgrasp.errors import ConfigError


def quiet(text: str) -> None:
    pass


def test_groups_are_what_is_missing_one_pile_each():
    plan = small_plan(runs=2)
    folder = Records()
    assert missing_groups(plan, folder) == [
        Group(task, seed, ("offline", "oracle"), True) for seed in (1000, 1001) for task in plan.tasks
    ]
    for record in (scene("clutter-06-fruit", 1000), *episode(EpisodeKey("oracle", "clutter-06-fruit", 1000))):
        folder.add(record)
    assert missing_groups(plan, folder)[0] == Group("clutter-06-fruit", 1000, ("offline",), False)


@pytest.mark.parametrize(("piles", "workers"), [(1, 1), (1, 2), (2, 2), (5, 2), (3, 16), (40, 16)])
def test_the_last_piles_are_shared_out_and_nothing_is_run_twice(piles, workers):
    methods = ("a", "b", "c", "d", "e")
    groups = deque(Group("task", seed, methods, needs_scene=True) for seed in range(piles))
    taken: list[Group] = []
    while groups:
        taken.append(take_group(groups, workers))
    assert sorted((g.seed, m) for g in taken for m in g.methods) == [(s, m) for s in range(piles) for m in methods]
    assert sorted(g.seed for g in taken if g.needs_scene) == list(range(piles))
    whole = piles if workers == 1 else max(0, piles - workers + 1)
    assert [len(g.methods) for g in taken[:whole]] == [5] * whole
    assert workers == 1 or len(taken[-1].methods) == 1


def test_a_run_holds_every_episode_once_and_says_how_far_it_is(tmp_path):
    said: list[str] = []
    records = run_benchmark(small_plan(), tmp_path, fake_source, said.append)
    assert len(records.episodes) == 12
    assert len(records.scenes) == 6
    assert len(said) == 12
    assert said[-1].startswith("12/12 oracle clutter-09-pear seed 1002: ")
    assert said[-1].endswith("about 0 s left")
    assert run_benchmark(small_plan(), tmp_path, fake_source, said.append).episodes == records.episodes
    assert len(said) == 12


def test_a_folder_takes_more_methods_and_runs(tmp_path):
    run_benchmark(small_plan(("offline",), runs=1), tmp_path, fake_source, quiet)
    plan = read_plan(tmp_path).merged(small_plan(("oracle",), runs=2))
    records = run_benchmark(plan, tmp_path, fake_source, quiet)
    assert {key.method for key in records.episodes} == {"offline", "oracle"}
    assert len(records.episodes) == 8
    kept = read_plan(tmp_path)
    assert ([m.name for m in kept.methods], kept.runs, len(kept.sessions)) == (["offline", "oracle"], 2, 2)


def test_an_episode_whose_process_dies_is_started_once_more(tmp_path):
    deaths = deque([1])

    def dying(plan, groups):
        while groups:
            group = groups.popleft()
            for record in fake_source(plan, deque([group])):
                if isinstance(record, StepRecord) and deaths:
                    yield record
                    deaths.pop()
                    yield Died(replace(group, needs_scene=False), "exit code -9")
                    break
                yield record

    said: list[str] = []
    records = run_benchmark(small_plan(), tmp_path, dying, said.append)
    assert any("exit code -9; going on in another process" in line for line in said)
    whole = run_benchmark(small_plan(), tmp_path / "whole", fake_source, quiet) if make(tmp_path / "whole") else None
    assert records.episodes == whole.episodes
    assert read_records(tmp_path).steps == whole.steps


def make(folder: Path) -> bool:
    folder.mkdir()
    return True


def test_an_episode_whose_process_dies_twice_counts_as_crashed_and_ends_nothing_else(tmp_path):
    def dying(plan, groups):
        while groups:
            group = groups.popleft()
            if group.needs_scene:
                yield scene(group.task, group.seed)
            for n, method in enumerate(group.methods):
                if (method, group.seed) == ("offline", 1001):
                    yield episode(group.key(method))[0]
                    yield Died(replace(group, needs_scene=False, methods=group.methods[n:]), "exit code -11")
                    break
                yield from episode(group.key(method))

    records = run_benchmark(small_plan(), tmp_path, dying, quiet)
    crashed = {key for key, e in records.episodes.items() if e.end == CRASHED}
    assert crashed == {EpisodeKey("offline", task, 1001) for task in small_plan().tasks}
    assert all(records.episodes[key].error == "exit code -11" for key in crashed)
    assert len(records.episodes) == 12
    again = run_benchmark(small_plan(), tmp_path, fake_source, quiet, retry_crashed=True)
    assert not any(e.end == CRASHED for e in again.episodes.values())


def test_piles_that_failed_are_made_again_when_asked_for(tmp_path):
    def without_piles(plan, groups):
        for group in groups:
            yield SceneRecord(group.task, group.seed, "I need a fruit", error="it rolls")
            for method in group.methods:
                yield EpisodeRecord(*group.key(method), success=False, end=NO_SCENE, steps=0, error="it rolls")

    run_benchmark(small_plan(), tmp_path, without_piles, quiet)
    kept = run_benchmark(small_plan(), tmp_path, fake_source, quiet)
    assert {e.end for e in kept.episodes.values()} == {NO_SCENE}
    run_benchmark(small_plan(), tmp_path, fake_source, quiet, retry_crashed=True)
    again, whole = read_records(tmp_path), Records()
    for record in fake_source(small_plan(), deque(missing_groups(small_plan(), whole))):
        whole.add(record)
    assert (again.scenes, again.episodes, again.steps) == (whole.scenes, whole.episodes, whole.steps)


def test_killed_at_any_moment_and_run_again_it_ends_with_the_same_records(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    whole.mkdir(), cut.mkdir()
    plan, slow = small_plan(runs=60), partial(fake_source, delay_s=0.002)
    fork, rng = multiprocessing.get_context("fork"), random.Random(0)
    for start in range(10):
        process = fork.Process(target=run_benchmark, args=(plan, cut, slow, quiet))
        process.start()
        while not (cut / "benchmark.json").exists() or len(read_plan(cut).sessions) <= start:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.15))
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    assert 0 < len(read_records(cut).episodes) < 240
    run_benchmark(plan, cut, fake_source, quiet)
    run_benchmark(plan, whole, fake_source, quiet)
    expected, found = read_records(whole), read_records(cut)
    assert (found.scenes, found.steps, found.episodes) == (expected.scenes, expected.steps, expected.episodes)
    lines = [(folder / "records.jsonl").read_bytes().splitlines() for folder in (whole, cut)]
    assert sorted(lines[0]) == sorted(lines[1])
    assert len(json.loads((cut / "benchmark.json").read_bytes())["sessions"]) == 11


def test_other_piles_in_one_folder_are_refused(tmp_path):
    run_benchmark(small_plan(), tmp_path, fake_source, quiet)
    with pytest.raises(ConfigError, match="the folder holds a benchmark with first_seed 1000, asked for is 7"):
        read_plan(tmp_path).merged(replace(small_plan(), first_seed=7))


def test_a_method_that_cannot_run_here_is_refused_and_not_kept(tmp_path):
    run_benchmark(small_plan(), tmp_path, fake_source, quiet)
    before = (tmp_path / "benchmark.json").read_bytes()
    with pytest.raises(ConfigError, match="method 'planner=mine' cannot run here: no planner named 'mine'"):
        run_benchmark(small_plan(("planner=mine",)), tmp_path, local_workers(1), quiet)
    assert (tmp_path / "benchmark.json").read_bytes() == before
    assert not multiprocessing.active_children()


def test_real_processes_run_real_episodes_and_outlive_a_killed_one(tmp_path):
    """Two workers; one is killed while it works."""
    from thinkgrasp.sim.options import CameraOptions

    plan = replace(small_plan(("oracle",), runs=1), camera=CameraOptions(size_wh=(224, 224)))
    killed: list[int] = []
    source = local_workers(2)

    def killing(plan, groups):
        for record in source(plan, groups):
            if isinstance(record, StepRecord) and not killed:
                child = multiprocessing.active_children()[0]
                killed.append(child.pid)
                os.kill(child.pid, signal.SIGKILL)
            yield record

    records = run_benchmark(plan, tmp_path, killing, quiet)
    assert killed
    assert {e.end for e in records.episodes.values()} == {"goal_delivered"}
    for key, found in records.episodes.items():
        assert isinstance(found, EpisodeRecord)
        steps = records.steps[key]
        assert sum(s.is_executed for s in steps) == found.steps
        assert steps[-1].is_goal_delivered
        assert steps[-1].is_right
    for s in records.scenes.values():
        assert s.fewest is None or s.fewest >= 1
        assert s.goals
