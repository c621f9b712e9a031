"""What else to ask for, and what a part belongs to."""

from __future__ import annotations

import pytest

from thinkgrasp.segmenters.names import head_noun, other_names, whole_and_part
from thinkgrasp.types import PlannedObject


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("red cracker box", "box"),
        ("bottle of ketchup", "bottle"),
        ("the mug to the left of the box", "mug"),
        ("a Nintendo controller", "controller"),
        ("something", None),
        ("mug", None),
        ("the mug", None),
        ("mug with a white handle", "mug"),
        ("of", None),
        ("", None),
    ],
)
def test_head_noun(name, head):
    assert head_noun(name) == head


@pytest.mark.parametrize(
    ("target", "whole", "part"),
    [
        ("red mug handle", "red mug", "handle"),
        ("black bread knife handle", "black bread knife", "handle"),
        ("the handle of the white mug", "white mug", "handle"),
        ("red mug: handle", "red mug", "handle"),
        ("scissors: finger hole", "scissors", "finger hole"),
        ("screwdriver shank", "screwdriver", "shank"),
        ("zorble knob", "zorble", "knob"),
        ("handle", "handle", None),
    ],
)
def test_whole_and_part(target, whole, part):
    assert whole_and_part(target) == (whole, part)


def test_the_head_noun_comes_first_and_then_the_best_of_the_others():
    objects = [
        PlannedObject("spoon", 20),
        PlannedObject("Red Box", 99),
        PlannedObject("cup", 80),
        PlannedObject("", 90),
    ]
    objects += [PlannedObject("box", 70), PlannedObject("cup", 60), PlannedObject("pan", 10)]
    assert other_names("red box", objects, 2) == ("box", "cup")
    assert other_names("red box", objects, 9) == ("box", "cup", "spoon", "pan")
    assert other_names("mug", [], 3) == ()
    assert other_names("mug", objects, 0) == ()
