"""The wire to the controller: it breaks, lags, lies and stands still in the middle of a motion."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.arm_scene import Scene, after, events
from fakes.lab import EMERGENCY, NORMAL, SAFEGUARD, FakeLab

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.robots.ur_link import Halted
from thinkgrasp.types import Outcome


def frozen_clock(scene: Scene) -> dict[str, Any]:
    def clock() -> float:
        scene.time_s += 0.1
        return scene.time_s

    return {"clock": clock}


def give_way(lab: FakeLab) -> None:
    """Hold the arm where it is, whatever it is told."""
    q = lab.world.joints()
    lab.after = lambda done: lab.world.set_joints(q, lab.world.opening())


FAULTS: dict[str, Callable[[FakeLab], None]] = {
    "protective_stop": lambda lab: lab.protective_stop(),
    "safeguard_stop": lambda lab: setattr(lab, "bits", SAFEGUARD | NORMAL),
    "emergency_stop": lambda lab: setattr(lab, "bits", EMERGENCY),
    "connection_lost": lambda lab: setattr(lab, "connected", False),
    "off_track": give_way,
}


@pytest.mark.parametrize(("reason", "periods"), [*((name, 30) for name in FAULTS), ("protective_stop", 300)])
def test_a_fault_in_the_middle_of_a_motion_stops_everything(scene, reason, periods):
    robot = scene.robot()
    after(scene.lab, periods, lambda: FAULTS[reason](scene.lab))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, reason)
    assert robot.halted == reason
    moved, q = scene.lab.moved, scene.world.joints()
    scene.world.step(200)
    assert np.abs(scene.world.joints() - q).max() < 0.06, "it has come to a stop"
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, reason)
    assert scene.lab.moved == moved, "nothing more was sent"
    assert events(robot, "halted")[0]["reason"] == reason
    assert scene.lab.unlocked == 0, "a protective stop is never released by itself"


@pytest.mark.parametrize("reason", ["safeguard_stop", "off_track"])
def test_after_a_stop_the_arm_has_no_position_left_to_go_to(scene, reason):
    """A paused program takes no command, and goes on to the last position when it is resumed: it has to be ended."""
    robot = scene.robot()
    after(scene.lab, 30, lambda: FAULTS[reason](scene.lab))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, reason)
    assert scene.lab.stops == 1 or not scene.lab.running


def test_an_arm_that_cannot_be_told_to_stop_is_said(scene):
    robot = scene.robot()
    after(scene.lab, 30, lambda: FAULTS["connection_lost"](scene.lab))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert "use the emergency stop" in str(events(robot, "halted")[0]["detail"])


def test_a_motion_that_ends_without_the_servo_letting_go_is_none(scene):
    robot = scene.robot()
    scene.lab.control_servoStop = lambda deceleration: False
    scene.lab.dashboard_stop = lambda: (_ for _ in ()).throw(RuntimeError("Failed to execute: stop"))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert "use the emergency stop" in str(events(robot, "halted")[0]["detail"])


def test_a_motion_does_not_go_on_after_the_vendors_module_has_connected_again(scene):
    robot = scene.robot()
    after(scene.lab, 40, lambda: setattr(scene.lab, "gap_s", 3.0))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert robot.halted == "connection_lost"
    assert scene.lab.moved < 45


def test_a_stream_that_stops_in_the_middle_of_a_motion(scene):
    robot = scene.robot(**frozen_clock(scene))
    after(scene.lab, 40, lambda: setattr(scene.lab, "frozen_clock", True))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.lab.moved < 50


def test_a_stream_that_stopped_while_the_question_was_open(scene):
    """The vendor's module goes on to return what it heard last, which looks fine."""
    robot = scene.robot()

    def allow(motion):
        scene.lab.frozen_clock = motion.name == "to the pre-grasp"
        return "yes"

    robot.person.allows = allow  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.lab.moved == 0
    with pytest.raises(InputError, match="nothing new came from the robot"):
        robot.T_world_flange()


def test_a_payload_that_the_controller_does_not_take(scene):
    robot = scene.robot()
    scene.lab.control_setPayload = lambda mass, center: False
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.lab.moved == 0


def test_a_program_that_was_stopped_on_the_pendant(scene):
    robot = scene.robot()
    after(scene.lab, 40, lambda: setattr(scene.lab, "running", False))
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert robot.halted == "connection_lost"


def test_a_controller_that_says_nothing_new(scene):
    robot = scene.robot(**frozen_clock(scene))
    scene.lab.frozen_clock = True
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.lab.moved < 10


def test_an_interrupt_from_the_keyboard_stops_the_arm(scene):
    robot = scene.robot()

    def interrupt() -> None:
        raise KeyboardInterrupt

    after(scene.lab, 30, interrupt)
    with pytest.raises(KeyboardInterrupt):
        robot.execute(scene.grasp(), scene.frame)
    assert scene.lab.stops == 1


# -- connecting ------------------------------------------------------------------------------------------------------


def test_no_robot_answers(scene):
    scene.lab.connected = False
    with pytest.raises(ConfigError, match=r"does not let itself be controlled: Could not connect .* remote control"):
        scene.robot()


def test_no_gripper_answers(scene):
    scene.lab.gripper.close()
    with pytest.raises(ConfigError, match="nothing answers for the gripper"):
        scene.robot()


def test_ur_rtde_is_not_installed(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(MissingDependency, match=r"pip install 'thinkgrasp\[ur\]'"):
        scene.robot()


def test_joint_angles_that_are_none(scene):
    robot = scene.robot()
    scene.lab.receive_getActualQ = lambda: [np.nan] * 6
    with pytest.raises(Halted, match="joint angles that are none"):
        robot.link.state()
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.untouched()


def test_forces_that_are_missing(scene):
    robot = scene.robot()
    scene.lab.receive_getActualTCPForce = list
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "connection_lost")
    assert scene.untouched()


def test_where_the_flange_is(scene):
    robot = scene.robot()
    np.testing.assert_allclose(robot.T_world_flange(), scene.world.flange(), atol=1e-4)
    scene.lab.connected = False
    with pytest.raises(InputError, match="connection to the robot"):
        robot.T_world_flange()


@pytest.mark.parametrize("module", ["rtde_control", "rtde_receive", "dashboard_client"])
def test_the_vendors_interface_has_what_the_fake_has(module):
    """The names that the driver and the fake use exist in ur_rtde, where it is installed."""
    from fakes.lab import CONTROL, DASHBOARD, RECEIVE

    vendor = pytest.importorskip(module, reason="ur_rtde is not installed: pip install 'thinkgrasp[ur]'")
    name, methods = {
        "rtde_control": ("RTDEControlInterface", CONTROL),
        "rtde_receive": ("RTDEReceiveInterface", RECEIVE),
        "dashboard_client": ("DashboardClient", DASHBOARD),
    }[module]
    assert [m for m in methods if not hasattr(getattr(vendor, name), m)] == []
