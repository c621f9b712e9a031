import json

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import GRIPPERS, Gripper


@pytest.mark.parametrize("name", sorted(GRIPPERS))
def test_bodies_leave_the_opening_free_and_meet_without_gaps(name):
    gripper = GRIPPERS[name]
    left, right, palm = gripper.bodies(0.05)
    assert (left[0] < left[1]).all()
    assert left[1, 0] == -0.025
    assert right[0, 0] == 0.025
    assert left[1, 2] == right[1, 2] == 0.0, "the TCP lies between the fingertips"
    assert palm[1, 2] == left[0, 2] == -gripper.finger_length_m
    np.testing.assert_allclose(left[:, 0], -right[::-1, 0])
    np.testing.assert_allclose(palm[:, :2], -palm[::-1, :2])


def test_a_gripper_written_to_a_file_is_read_back(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(GRIPPERS["franka_hand"].to_dict()))
    assert Gripper.load(path) == GRIPPERS["franka_hand"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not readable JSON"),
        ("[]", "must be an object"),
        ('{"name": "x", "colour": 1}', "must be an object with the fields"),
        ('{"name": "x"}', "missing"),
    ],
)
def test_broken_files_are_named(tmp_path, text, message):
    path = tmp_path / "mine.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        Gripper.load(path)


def test_an_unknown_name_lists_the_built_in_ones():
    with pytest.raises(ConfigError, match="robotiq_2f85"):
        Gripper.load("robotiq_2f8")


@pytest.mark.parametrize(
    "change",
    [
        {"max_width_m": 0.0},
        {"finger_length_m": 85.0},
        {"palm_size_m": (0.1, 0.1)},
        {"min_width_m": 0.09},
        {"pad_length_m": 0.2},
        {"finger_breadth_m": float("nan")},
    ],
)
def test_impossible_geometry_is_refused(change):
    fields = GRIPPERS["robotiq_2f85"].to_dict() | change
    with pytest.raises(ConfigError, match="robotiq_2f85"):
        Gripper(**fields)
