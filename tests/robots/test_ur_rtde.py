"""The real arm's driver over a simulated world behind the vendor's interface; we try to break every rule of safety."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.arm_scene import MOTIONS, Scene, after, events
from fakes.cell import top_down
from fakes.lab import EMERGENCY, NORMAL, PROTECTIVE, SAFEGUARD, FakeLab, ScriptedPerson, make_cell
from fakes.things import ball

from thinkgrasp import testing
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.lab.agreement import CalibrationRecord
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.robotiq_2f85 import flange_to_tip
from thinkgrasp.motion.trajectory import time_path
from thinkgrasp.robots.ur_rtde import URRobot
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.world import World
from thinkgrasp.types import Grasp, Outcome

# -- an attempt ------------------------------------------------------------------------------------------------------


def test_delivers_and_asks_before_every_motion(scene):
    person = ScriptedPerson()
    robot = scene.robot(person)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(True, "held")
    assert scene.world.settle()
    assert scene.world.in_bin(0)
    assert scene.is_home()
    assert tuple(m.name for m in person.asked) == MOTIONS
    assert [e["answer"] for e in events(robot, "asked")] == ["yes"] * len(MOTIONS)
    assert events(robot, "outcome")[-1]["reason"] == "held"
    assert scene.lab.stops == 5, "every motion ends with a stop of the servo"
    assert robot.halted is None


def test_a_world_that_is_not_the_robots_base(scene):
    """The same lab, its world turned by a quarter and moved: cell, camera and bin say so."""
    T_world_base = np.array([[0.0, -1, 0, 0.2], [1, 0, 0, 0.1], [0, 0, 1, 0], [0, 0, 0, 1]])
    cell = {
        "robot.T_world_base": T_world_base.tolist(),
        "workspace_m": [[-0.58, 0.1, -0.005], [0.62, 1.05, 0.9]],
        "grasping_m": [[-0.2, 0.32, 0.0], [0.6, 0.88, 0.35]],
        "table": {"x_m": [-0.6, 0.8], "y_m": [-0.25, 1.15]},
        "bin": {"x_m": [-0.55, -0.25], "y_m": [0.35, 0.75], "height_m": 0.12},
        "obstacles": [{"name": "mount_pole", "center_m": [0.2, 1.08, 0.375], "size_m": [0.03, 0.03, 0.75]}],
    }
    person = ScriptedPerson()
    robot = scene.robot(person, cell)
    frame = replace(scene.frame, T_world_camera=T_world_base @ scene.frame.T_world_camera)
    assert robot.execute(scene.grasp(), frame) == Outcome(True, "held"), person.told
    assert scene.world.settle()
    assert scene.world.in_bin(0)
    np.testing.assert_allclose(robot.T_world_flange(), T_world_base @ scene.world.flange(), atol=1e-3)


def test_an_arm_that_follows_late_delivers_all_the_same(scene):
    scene.lab.lag_s = 0.1
    assert scene.robot().execute(scene.grasp(), scene.frame) == Outcome(True, "held")
    assert scene.is_home()


def test_a_grasp_beside_the_thing_misses_and_goes_home(scene):
    assert scene.robot().execute(scene.grasp(y=0.15), scene.frame) == Outcome(False, "missed")
    assert scene.is_home()


def test_what_slips_out_is_not_called_held(scene):
    lab = scene.lab

    def steal(periods: int) -> None:
        if lab.world.flange()[2, 3] > 0.3 and lab.world.held() == 0:
            lab.world.park(0)

    robot = scene.robot()
    robot.person.allows = lambda motion: (
        setattr(lab, "after", steal if motion.name == "straight up" else lab.after) or "yes"
    )  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "slipped")
    assert scene.is_home()


def test_a_thing_that_was_not_seen_stops_the_arm_and_it_backs_out(scene):
    scene.world.place(1, pose(0.53, 0.0, 0.025))
    scene.world.park(0)
    scene.world.settle()
    robot = scene.robot()
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "collision")
    assert events(robot, "pressed")[0]["name"] == "straight in"
    assert scene.world.joints() == pytest.approx(HOME_RAD, abs=0.02)
    assert robot.halted is None


def test_a_dry_run_plans_and_moves_nothing(scene):
    person = ScriptedPerson()
    robot = scene.robot(person, dry_run=True)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "dry_run")
    assert not scene.lab.controlled
    assert scene.lab.gripper.requests == []
    assert scene.lab.moved == 0
    assert person.asked == []
    told = " / ".join(person.told)
    for part in ("to the pre-grasp", "straight in", "straight up", "to the bin"):
        assert f"would move {part}" in told
    assert [e["name"] for e in events(robot, "planned")] == [
        "to the pre-grasp",
        "straight in",
        "straight up",
        "to the bin",
    ]


@pytest.mark.parametrize("state", [{"mode": 3}, {"slider": 0.2}, {"bits": PROTECTIVE}])
def test_a_dry_run_does_not_need_an_arm_that_could_move(scene, state):
    for name, value in state.items():
        setattr(scene.lab, name, value)
    person = ScriptedPerson()
    assert scene.robot(person, dry_run=True).execute(scene.grasp(), scene.frame) == Outcome(False, "dry_run")
    assert person.told[0].startswith("the arm could not move now")


def test_speeds_stay_below_the_limits(scene):
    limits = {"limits.joint_speed_rad_s": 0.5, "limits.tcp_speed_m_s": 0.2, "limits.approach_speed_m_s": 0.04}
    robot = scene.robot(cell=limits)
    fastest = {"joint": 0.0, "tip": 0.0, "in": 0.0}
    last: list[np.ndarray] = []
    current = {"name": ""}
    send = scene.lab.control_servoJ

    def watch(q: list[float], *rest: float) -> bool:
        if last:
            a, b = robot.cell.fingertips(np.array([last[-1], q]))
            fastest["joint"] = max(fastest["joint"], float(np.abs(np.array(q) - last[-1]).max()) / 0.008)
            speed = float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / 0.008
            fastest["in" if current["name"] in ("straight in", "straight up") else "tip"] = max(
                fastest["in" if current["name"] in ("straight in", "straight up") else "tip"], speed
            )
        last.append(np.array(q))
        return send(q, *rest)

    scene.lab.control_servoJ = watch

    def allow(motion):
        current["name"] = motion.name
        last.clear()
        return "yes"

    robot.person.allows = allow  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame).success
    assert 0.1 < fastest["joint"] <= 0.51
    assert 0.05 < fastest["tip"] <= 0.205
    assert 0.02 < fastest["in"] <= 0.041


def test_keeps_the_contract_of_a_robot(scene):
    testing.check_robot(scene.robot())


def test_a_ball_too(scene, monkeypatch):
    world = World([ball(0.03, (0.1, 0.2, 0.8))])
    world.place(0, pose(0.5, 0.05, 0.03))
    world.settle()
    lab = FakeLab(world, noise="d455")
    for name, module in lab.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    robot = URRobot(cell=make_cell(lab.gripper.port), person=ScriptedPerson(), sleep=lambda s: None)
    grasp = top_down(0.5, 0.05, 0.025, width=0.075, view=lab.view)
    assert robot.execute(grasp, lab.camera.read()) == Outcome(True, "held")
    robot.close()
    lab.close()


# -- an arm that is not at home --------------------------------------------------------------------------------------

AWAY = np.add(HOME_RAD, [-0.5, 0.1, -0.2, 0.1, 0.0, 0.3])


def test_an_arm_that_is_elsewhere_does_not_take_what_the_camera_saw(scene):
    """The camera may have taken the arm itself for a thing."""
    scene.world.set_joints(AWAY, 0.085)
    robot = scene.robot()
    assert robot.execute(scene.grasp(), scene.lab.camera.read()) == Outcome(False, "not_at_home")
    assert scene.untouched()
    assert robot.halted == "not_at_home"


def test_it_comes_home_first_when_the_person_agrees(scene):
    scene.world.set_joints(AWAY, 0.085)
    person = ScriptedPerson()
    robot = scene.robot(person)
    robot.prepare(scene.lab.camera.read())
    assert [m.name for m in person.asked] == ["home"]
    assert "from home" in " ".join(person.told)
    assert robot.halted is None
    assert scene.is_home()
    assert robot.execute(scene.grasp(), scene.frame).success


@pytest.mark.parametrize(("answer", "halted"), [("no", None), ("stop", "stopped_by_person")])
def test_it_stays_away_when_the_person_does_not_agree(scene, answer, halted):
    scene.world.set_joints(AWAY, 0.085)
    robot = scene.robot(ScriptedPerson([answer]))
    robot.prepare(scene.lab.camera.read())
    assert scene.lab.moved == 0
    assert robot.halted == halted
    assert not robot.execute(scene.grasp(), scene.frame).success
    assert scene.lab.moved == 0


def test_an_arm_at_home_is_not_asked_about(scene):
    person = ScriptedPerson()
    scene.robot(person).prepare(scene.frame)
    assert (person.asked, person.told, scene.lab.moved) == ([], [], 0)


def test_a_dry_run_says_that_the_arm_is_elsewhere_and_plans_all_the_same(scene):
    scene.world.set_joints(AWAY, 0.085)
    person = ScriptedPerson()
    robot = scene.robot(person, dry_run=True)
    robot.prepare(scene.frame)
    assert "from home" in " ".join(person.told)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "dry_run")
    assert scene.untouched()


# -- nothing moves before all checks pass ----------------------------------------------------------------------------


def broken(grasp: Grasp, **changes: Any) -> Grasp:
    return replace(grasp, **changes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"position": np.array([0.0, np.nan, 0.5])}, "invalid_pose"),
        ({"position": np.array([0.0, np.inf, 0.5])}, "invalid_pose"),
        ({"rotation": np.full((3, 3), np.nan)}, "invalid_pose"),
        ({"rotation": np.zeros((3, 3))}, "invalid_pose"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "invalid_pose"),
        ({"width_m": float("nan")}, "invalid_pose"),
        ({"width_m": -0.01}, "invalid_pose"),
        ({"position": np.array([0.0, 0.0, 3.0])}, "outside_grasping_area"),
        ({"position": np.array([1.0, 0.0, 0.5])}, "outside_grasping_area"),
    ],
)
def test_a_pose_that_is_none_or_outside_is_refused(scene, change, reason):
    robot = scene.robot()
    assert robot.execute(broken(scene.grasp(), **change), scene.frame) == Outcome(False, reason)
    assert scene.untouched()
    assert robot.halted is None, "the next grasp may be a good one"


def test_a_grasp_under_the_table_or_too_near_to_it_is_refused(scene):
    robot = scene.robot()
    assert robot.execute(scene.grasp(z=-0.03), scene.frame) == Outcome(False, "outside_grasping_area")
    assert scene.untouched()


def test_a_way_that_leaves_the_box_is_refused_before_anything_moves(scene):
    robot = scene.robot()
    robot.motion.plan_to_poses = lambda q, *rest: time_path(  # type: ignore[method-assign]
        np.array([q, np.add(q, [-1.5, 0.0, 0.0, 0.0, 0.0, 0.0]), q]), robot.cell.joint_limits
    )
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "outside_workspace")
    assert scene.untouched()


def test_a_frame_without_pose_is_an_error(scene):
    with pytest.raises(InputError, match="T_world_camera is missing"):
        scene.robot().execute(scene.grasp(), replace(scene.frame, T_world_camera=None))
    assert scene.untouched()


@pytest.mark.parametrize(
    ("tcp", "word"),
    [
        (make_transform(np.eye(3), np.array([0, 0, 0.0])), "tool"),
        (flange_to_tip(0.0) @ make_transform(np.eye(3), np.array([0, 0, 0.03])), "tool"),
        (flange_to_tip(0.0) @ make_transform(np.eye(3), np.array([0.012, 0, 0])), "tool"),
    ],
    ids=["none set", "30 mm longer", "12 mm aside"],
)
def test_a_tcp_that_disagrees_is_refused(scene, tcp, word):
    scene.lab.tcp = tcp
    person = ScriptedPerson()
    robot = scene.robot(person)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "checks_failed")
    assert scene.untouched()
    assert robot.halted == "checks_failed"
    assert any(line.startswith(f"failed {word}") for line in person.told)
    scene.lab.tcp = flange_to_tip(0.0)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "checks_failed"), "until a person starts anew"
    assert scene.untouched()


@pytest.mark.parametrize(
    ("T", "word"),
    [
        (make_transform(np.eye(3), np.array([0, 0, 0.02])), "table"),
        (make_transform(np.array([[1, 0, 0], [0, 0.9986, -0.0523], [0, 0.0523, 0.9986]]), np.zeros(3)), "table"),
        (make_transform(np.eye(3), np.array([0.10, 0.0, 0.0])), "arm in view"),
    ],
    ids=["20 mm too high", "tilted by 3 deg", "100 mm aside"],
)
def test_a_calibration_that_disagrees_is_refused(scene, T, word):
    """The camera's file is wrong; the robot is where it was."""
    person = ScriptedPerson()
    robot = scene.robot(person)
    wrong = replace(scene.frame, T_world_camera=T @ scene.frame.T_world_camera)
    assert robot.execute(scene.grasp(), wrong) == Outcome(False, "checks_failed")
    assert scene.untouched()
    assert any(line.startswith(f"failed {word}") for line in person.told), person.told


@pytest.mark.parametrize(
    ("record", "detail"),
    [
        (CalibrationRecord("hand", np.eye(4), 1.0, 0.1, 15), "mounted 'hand'"),
        (CalibrationRecord("fixed", make_transform(np.eye(3), np.array([0.01, 0, 0])), 1.0, 0.1, 15), "10.0 mm"),
        (CalibrationRecord("fixed", np.eye(4), 25.0, 0.1, 15), "its error was 25.0 mm"),
    ],
)
def test_a_record_that_does_not_fit_the_cell_is_refused(scene, record, detail):
    person = ScriptedPerson()
    assert scene.robot(person, record=record).execute(scene.grasp(), scene.frame) == Outcome(False, "checks_failed")
    assert scene.untouched()
    assert detail in " ".join(person.told)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        ({"bits": PROTECTIVE}, "protective_stop"),
        ({"bits": SAFEGUARD}, "safeguard_stop"),
        ({"bits": EMERGENCY}, "emergency_stop"),
        ({"bits": 1 << 9}, "safety_fault"),
        ({"bits": 0}, "safety_fault"),
        ({"mode": 5}, "robot_not_ready"),
        ({"slider": 0.5}, "robot_not_ready"),
        ({"connected": False}, "connection_lost"),
    ],
)
def test_a_robot_that_is_not_ready_is_not_moved(scene, state, reason):
    robot = scene.robot()
    for name, value in state.items():
        setattr(scene.lab, name, value)
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, reason)
    assert scene.untouched()
    assert robot.halted == reason
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, reason)


# -- ways back -------------------------------------------------------------------------------------------------------


def test_no_way_home_leaves_the_arm_over_the_bin(scene):
    robot = scene.robot()

    def allow(motion):
        if motion.name == "open the gripper over the bin":
            robot.motion.plan_to = lambda *args: "no path"
        return "yes"

    robot.person.allows = allow  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "no_way_home")
    assert robot.halted == "no_way_home"


class TestProtectiveStop:
    def stopped(self, scene: Scene, person: ScriptedPerson) -> tuple[URRobot, Outcome]:
        robot = scene.robot(person)
        after(scene.lab, 60, scene.lab.protective_stop)
        return robot, robot.execute(scene.grasp(), scene.frame)

    def test_is_released_only_when_the_person_says_so(self, scene):
        person = ScriptedPerson(confirms=[True])
        robot, outcome = self.stopped(scene, person)
        assert outcome == Outcome(False, "protective_stop")
        assert scene.lab.unlocked == 1
        assert "Release it?" in person.questions[0]
        assert [m.name for m in person.asked[-2:]] == ["open the gripper and let go of what it may hold", "home"]
        assert robot.halted is None
        assert scene.is_home()
        scene.lab.after = lambda done: None
        assert robot.execute(scene.grasp(), scene.frame).success

    def test_is_released_late_and_its_program_starts_late(self, scene):
        """The controller refuses for five seconds, and says for a while that it is still stopped."""
        unlock, reupload = scene.lab.dashboard_unlockProtectiveStop, scene.lab.control_reuploadScript

        def later(what: Callable[[], Any], seconds: float) -> None:
            due = scene.lab.time_s + seconds
            look = scene.lab.receive_getSafetyStatusBits
            scene.lab.receive_getSafetyStatusBits = lambda: (
                (what() if scene.lab.time_s > due and scene.lab.bits == PROTECTIVE else None) or look()
            )

        def release() -> None:
            unlock()
            scene.lab.bits = PROTECTIVE
            later(lambda: setattr(scene.lab, "bits", NORMAL), 1.0)

        def upload() -> bool:
            assert scene.lab.bits == NORMAL, "no program starts in a protective stop"
            return reupload()

        scene.lab.dashboard_unlockProtectiveStop, scene.lab.control_reuploadScript = release, upload
        robot, outcome = self.stopped(scene, ScriptedPerson(confirms=[True]))
        assert outcome == Outcome(False, "protective_stop")
        assert scene.lab.unlocked == 1
        assert robot.halted is None
        assert scene.is_home()

    def test_stays_when_its_program_does_not_start_again(self, scene):
        scene.lab.control_reuploadScript = lambda: False
        robot, outcome = self.stopped(scene, ScriptedPerson(confirms=[True]))
        assert (outcome.reason, robot.halted) == ("protective_stop", "protective_stop")

    def test_released_before_anything_was_looked_at_moves_nothing(self, scene):
        scene.lab.protective_stop()
        person = ScriptedPerson(confirms=[True])
        robot = scene.robot(person)
        assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "protective_stop")
        assert (scene.lab.unlocked, robot.halted) == (1, None)
        assert scene.untouched()
        assert person.asked == []

    def test_stays_when_the_person_says_no(self, scene):
        robot, outcome = self.stopped(scene, ScriptedPerson(confirms=[False]))
        assert outcome == Outcome(False, "protective_stop")
        assert (scene.lab.unlocked, robot.halted) == (0, "protective_stop")

    def test_every_motion_after_the_release_is_asked_for(self, scene):
        person = ScriptedPerson(["yes", "yes", "no"], confirms=[True])
        robot, _ = self.stopped(scene, person)
        assert scene.lab.unlocked == 1
        assert robot.halted is not None

    def test_that_comes_back_at_once(self, scene):
        scene.lab.dashboard_unlockProtectiveStop = lambda: None
        robot, outcome = self.stopped(scene, ScriptedPerson(confirms=[True]))
        assert outcome == Outcome(False, "protective_stop")
        assert robot.halted == "protective_stop"
