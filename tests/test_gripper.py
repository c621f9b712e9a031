"""Gripper geometry and its files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import GRIPPERS, Gripper

ROBOTIQ = GRIPPERS["robotiq_2f85"]


@pytest.mark.parametrize("name", GRIPPERS)
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_bodies_fit_together(name, share):
    gripper = GRIPPERS[name]
    width = share * gripper.max_width_m
    left, right, palm = gripper.bodies(width)
    assert (left[0] < left[1]).all()
    assert right[0, 0] - left[1, 0] == pytest.approx(width), "the opening is free"
    assert np.allclose(left[:, 0], -right[::-1, 0]), "symmetric in the closing direction"
    assert left[1, 2] == right[1, 2] == 0, "the TCP lies between the tips"
    assert palm[1, 2] == pytest.approx(left[0, 2]), "the palm begins where the fingers end"


@pytest.mark.parametrize("name", GRIPPERS)
def test_files_round_trip(name, tmp_path):
    (tmp_path / "g.json").write_text(json.dumps(GRIPPERS[name].to_dict()))
    assert Gripper.load(tmp_path / "g.json") == GRIPPERS[name] == Gripper.load(name)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_width_m": 0.0}, "every length must lie in"),
        ({"finger_length_m": -0.1}, "every length must lie in"),
        ({"finger_breadth_m": float("nan")}, "every length must lie in"),
        ({"max_width_m": 85.0}, "every length must lie in"),
        ({"palm_size_m": (0.1, 0.1)}, "every length must lie in"),
        ({"min_width_m": 0.2}, "min_width_m < max_width_m"),
        ({"pad_length_m": 0.2}, "pad_length_m is longer"),
    ],
)
def test_impossible_geometry(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(ROBOTIQ, **changes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not readable JSON"),
        ("[]", "must be an object with the fields"),
        ('{"name": "x"}', "fields are"),
        (json.dumps({**ROBOTIQ.to_dict(), "colour": "red"}), "must be an object with the fields"),
        (json.dumps({**ROBOTIQ.to_dict(), "max_width_m": "wide"}), "g.json"),
        (json.dumps({**ROBOTIQ.to_dict(), "palm_size_m": 0.1}), "g.json"),
        (json.dumps({**ROBOTIQ.to_dict(), "max_width_m": None}), "g.json"),
    ],
)
def test_broken_files(tmp_path, content, message):
    (tmp_path / "g.json").write_text(content)
    with pytest.raises(ConfigError, match=message):
        Gripper.load(tmp_path / "g.json")


def test_unknown_name():
    with pytest.raises(ConfigError, match=r"no gripper 'tweezers': built-in are \['franka_hand'"):
        Gripper.load("tweezers")
