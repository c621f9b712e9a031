"""Single motions: what the person, a force or the gripper says, we try to have ignored."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.arm_scene import MOTIONS, events
from fakes.lab import ScriptedPerson

from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.types import Outcome


@pytest.mark.parametrize("name", MOTIONS[:2])
def test_the_person_says_no_before_the_arm_has_moved(scene, name):
    answers = ["yes"] * MOTIONS.index(name) + ["no"]
    robot = scene.robot(ScriptedPerson(answers))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "refused_by_person")
    assert scene.lab.moved == 0
    assert robot.halted is None, "another grasp may be offered"


@pytest.mark.parametrize("name", ["straight in", "straight up"])
def test_the_person_says_no_in_the_middle(scene, name):
    answers = ["yes"] * MOTIONS.index(name) + ["no"]
    robot = scene.robot(ScriptedPerson(answers))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "refused_by_person")
    moved = scene.lab.moved
    assert robot.halted == "refused_by_person", "the arm is not at home: nothing goes on by itself"
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "refused_by_person")
    assert scene.lab.moved == moved


def test_an_arm_that_was_moved_while_the_question_was_open(scene):
    robot = scene.robot()

    def allow(motion):
        if motion.name == "to the pre-grasp":
            scene.world.set_joints(np.array(HOME_RAD) + 0.05, scene.world.opening())
        return "yes"

    robot.person.allows = allow  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "jump")
    assert scene.lab.moved == 0


def test_the_person_says_stop(scene):
    robot = scene.robot(ScriptedPerson(["stop"]))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "stopped_by_person")
    assert robot.halted == "stopped_by_person"
    assert scene.lab.moved == 0


def test_stop_with_something_in_the_fingers_leaves_their_grip(scene):
    robot = scene.robot(ScriptedPerson(["yes"] * MOTIONS.index("to the bin") + ["stop"]))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "stopped_by_person")
    assert scene.lab.gripper.registers["GTO"] == 1
    assert scene.world.held() == 0


def test_a_force_above_the_limit_stops_a_motion(scene):
    robot = scene.robot(cell={"limits.force_n": 20.0})
    names: list[str] = []

    def push(done: int) -> None:
        scene.lab.force_n = 25.0 if names[-1:] == ["straight in"] else 0.0

    scene.lab.after = push
    robot.person.allows = lambda motion: names.append(motion.name) or "yes"  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "collision")
    assert events(robot, "pressed")[0]["name"] == "straight in"
    assert names[-2:] == ["back the way it came", "home"]
    assert scene.world.joints() == pytest.approx(HOME_RAD, abs=0.02)


# -- the gripper -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", ["SET POS", "GET OBJ"])
def test_a_gripper_that_falls_silent_stops_everything(scene, at):
    robot = scene.robot()
    scene.lab.gripper.spoil = lambda request, reply: b"" if request.startswith(at) else reply
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "gripper_silent")
    assert robot.halted == "gripper_silent"
    assert scene.lab.moved == 0


def test_a_gripper_that_falls_silent_while_it_holds(scene):
    robot = scene.robot()
    robot.person.allows = lambda motion: (
        (  # type: ignore[method-assign]
            setattr(scene.lab.gripper, "spoil", lambda request, reply: None) if motion.name == "to the bin" else None
        )
        or "yes"
    )
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "gripper_silent")
    moved = scene.lab.moved
    assert robot.halted == "gripper_silent"
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "gripper_silent")
    assert scene.lab.moved == moved


def test_a_gripper_with_a_fault(scene):
    scene.lab.gripper.registers["FLT"] = 14
    robot = scene.robot()
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "gripper_fault")
    assert scene.lab.moved == 0
    assert "overcurrent" in " ".join(robot.person.told)  # type: ignore[attr-defined]


def test_a_gripper_that_does_not_open_as_told(scene):
    scene.lab.gripper.spoil = lambda request, reply: b"POS 200" if reply[:3] == b"POS" else reply
    robot = scene.robot()
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "gripper_fault")
    assert scene.lab.moved == 0
    assert scene.lab.gripper.registers["GTO"] == 0


def test_an_inactive_gripper_is_activated_when_the_person_agrees(scene):
    scene.lab.gripper.registers.update(ACT=0, STA=0, GTO=0)
    person = ScriptedPerson()
    assert scene.robot(person).execute(scene.grasp(), scene.frame).success
    assert person.asked[0].name == "activate the gripper"
