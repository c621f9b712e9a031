"""Named tasks, and the referee's rule of what serves an instruction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.sim import catalogue, scenes
from thinkgrasp.sim.goals import goals_in
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.tasks import TASKS, find_task, task_for
from thinkgrasp.sim.urdf import load_objects

YCB = Path(__file__).parents[3] / "shared" / "objects_ycb"


def things(*names: str) -> tuple[SimObject, ...]:
    return tuple(catalogue.make(name) for name in names)


def test_names_are_unique_and_found_by_name_or_ending():
    assert len({task.name for task in TASKS}) == 16
    assert find_task("heavy-04-fruit").instruction == "I need a fruit"
    assert find_task("pear").name == "clutter-09-pear"
    assert (find_task("pear").step_limit, find_task("fruit_hard").step_limit) == (15, 50)
    assert (find_task("pear").n_objects, find_task("fruit_hard").n_objects) == ((8, 15), (20, 30))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fruit", "'fruit' may be clutter-06-fruit or heavy-04-fruit; say which"),
        ("pera", "no task 'pera'. Did you mean 'pear'\\? Tasks are clutter-00-round, "),
        ("", "no task ''. Tasks are"),
    ],
)
def test_a_wrong_name_is_answered_with_the_right_ones(name, message):
    with pytest.raises(ConfigError, match=message):
        find_task(name)


@pytest.mark.parametrize(
    ("instruction", "names", "serve"),
    [
        ("grasp a round object", "plum pear racquetball tape egg mug", "plum racquetball egg"),
        ("get something to eat", "apple mustard_bottle cracker_box water_bottle hammer", "apple cracker_box"),
        ("get something to eat", "mustard_bottle hammer", "mustard_bottle"),
        ("get something to hold other things", "blue_cup tuna_can bowl sugar_box", "blue_cup bowl"),
        ("give me the cup", "blue_cup mug tea_cup stacking_cup bowl", "blue_cup tea_cup stacking_cup"),
        ("the red cup", "blue_cup red_cup", "red_cup"),
        ("I need a fruit", "lemon tomato pear lego_brick", "lemon pear"),
        ("get something to drink", "soda_can mug hammer", "soda_can"),
        ("give me the thera_med", "thera_med toothpaste_tube soap", "thera_med"),
        ("grasp a ball", "softball orange golf_ball", "softball golf_ball"),
        ("something to eat but not the apple", "apple pear hammer", "pear"),
        ("the scissors", "scissors knife", "scissors"),
        ("anything", "scissors knife", "scissors knife"),
        ("frobnicate", "scissors knife", ""),
    ],
)
def test_what_serves(instruction, names, serve):
    objects = things(*(name.replace("_", " ") for name in names.split()))
    expected = [name.replace("_", " ") for name in serve.split()]
    assert [objects[i].name for i in goals_in(instruction, objects)] == expected


def test_a_name_that_nobody_knows_is_still_a_name():
    gizmo = replace(catalogue.make("wrench"), name="gizmo", uses=())
    assert goals_in("hand me the gizmo please", (catalogue.make("wrench"), gizmo)) == (1,)


@pytest.mark.parametrize("task", TASKS, ids=lambda t: t.name)
def test_every_task_finds_its_goals_and_nothing_else_serves(task):
    pool = "seen" if task.suite == "clutter" else "unseen"
    for seed in range(3):
        rng = np.random.default_rng(seed)
        chosen = scenes.choose(task.instruction, task.n_objects[1], task.n_goals, pool, rng)
        assert len(chosen.objects) == task.n_objects[1]
        assert goals_in(task.instruction, chosen.objects) == chosen.goals == tuple(range(task.n_goals))
        assert {o.name for o in chosen.objects} <= set(catalogue.split(pool))


def test_a_free_instruction_chooses_its_goal():
    scene = task_for("the scissors", 3)
    assert [scene.spec.objects[g].name for g in scene.spec.goals] == ["scissors"]
    assert len(scene.spec.objects) == 11


def test_an_instruction_that_names_nothing_lists_what_there_is():
    with pytest.raises(InputError, match=r"'frobnicate' names nothing .*; there are apple, "):
        task_for("frobnicate", 0)
    with pytest.raises(InputError, match=r"'the banana' names nothing .*; your objects are gizmo"):
        task_for("the banana", 0, own=(replace(catalogue.make("wrench"), name="gizmo"),))
    with pytest.raises(ConfigError, match="a seed must not be negative, got -1"):
        task_for("the banana", -1)


@pytest.mark.skipif(not YCB.is_dir(), reason=f"no scanned objects at {YCB}")
@pytest.mark.parametrize("name", ["banana", "cracker box", "mustard bottle", "scissors", "tomato soup can"])
def test_own_objects_have_no_twins_in_the_pile(name):
    own = load_objects(YCB)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        chosen = scenes.choose(f"give me the {name}", 11, 1, "all", rng, own)
        assert chosen.objects[0].source.startswith(str(YCB))
        assert goals_in(f"give me the {name}", chosen.objects) == (0,) == chosen.goals
        assert [o.name for o in chosen.objects].count(name) == 1
        assert all(o.source == "catalogue" for o in chosen.objects[1:])
