"""The real arm's driver over a simulated world behind the vendor's interface; we try to break every rule of safety."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import look, top_down
from fakes.lab import EMERGENCY, NORMAL, PROTECTIVE, SAFEGUARD, FakeLab, ScriptedPerson, make_cell
from fakes.things import ball, box

from thinkgrasp import testing
from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.geometry import make_transform
from thinkgrasp.lab.agreement import CalibrationRecord
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.robotiq_2f85 import flange_to_tip
from thinkgrasp.motion.trajectory import time_path
from thinkgrasp.robots.ur_link import Halted
from thinkgrasp.robots.ur_rtde import URRobot
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.views import default_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Grasp, Outcome

BLOCK = box((0.04, 0.06, 0.05), (0.8, 0.1, 0.1))
MOTIONS = (
    *("open the gripper to 54 mm", "to the pre-grasp", "straight in", "close the gripper", "straight up"),
    *("to the bin", "open the gripper over the bin", "home"),
)


@cache
def _frame_of_the_block() -> Frame:
    return look(_world(), default_view("l515", (320, 240)))


def _world() -> World:
    """A block on the table, and a heavy one that is not there yet."""
    world = World([BLOCK, replace(BLOCK, mass_kg=8.0)])
    world.place(0, pose(0.5, 0.0, 0.025))
    world.settle()
    return world


class Scene:
    """A block on the table of a fake lab, a frame of it, and a grasp that works."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.world = _world()
        self.lab = FakeLab(self.world, noise=None)
        for name, module in self.lab.modules().items():
            monkeypatch.setitem(sys.modules, name, module)
        self.frame = _frame_of_the_block()
        self.robots: list[URRobot] = []
        self.time_s = 0.0

    def grasp(self, x: float = 0.5, y: float = 0.0, z: float = 0.02, width: float = 0.054) -> Grasp:
        return top_down(x, y, z, width=width, view=self.lab.view)

    def robot(self, person: ScriptedPerson | None = None, cell: dict[str, Any] | None = None, **settings) -> URRobot:
        made = make_cell(self.lab.gripper.port, **(cell or {}))
        settings = {"sleep": self.lab.sleep, "clock": self.lab.clock, **settings}
        self.robots.append(URRobot(cell=made, person=person or ScriptedPerson(), **settings))
        return self.robots[-1]

    def untouched(self) -> bool:
        """Whether neither arm nor fingers were ever told to move."""
        told = [r for r in self.lab.gripper.requests if r.startswith("SET")]
        return self.lab.moved == 0 and not told

    def is_home(self) -> bool:
        return bool(np.abs(self.world.joints() - HOME_RAD).max() < 0.02 and self.world.opening() > 0.08)


@pytest.fixture
def scene(monkeypatch) -> Iterator[Scene]:
    made = Scene(monkeypatch)
    yield made
    for robot in made.robots:
        robot.close()
    made.lab.close()


def events(robot: URRobot, name: str) -> list[dict[str, object]]:
    return [line for line in robot.journal.lines if line["event"] == name]


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


# -- while it moves --------------------------------------------------------------------------------------------------


def after(lab: FakeLab, periods: int, fault: Callable[[], None]) -> None:
    lab.after = lambda done: fault() if done == periods else None


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


def test_no_way_home_leaves_the_arm_over_the_bin(scene):
    robot = scene.robot()

    def allow(motion):
        if motion.name == "open the gripper over the bin":
            robot.motion.plan_to = lambda *args: "no path"
        return "yes"

    robot.person.allows = allow  # type: ignore[method-assign]
    assert robot.execute(scene.grasp(), scene.frame) == Outcome(False, "no_way_home")
    assert robot.halted == "no_way_home"


def test_an_interrupt_from_the_keyboard_stops_the_arm(scene):
    robot = scene.robot()

    def interrupt() -> None:
        raise KeyboardInterrupt

    after(scene.lab, 30, interrupt)
    with pytest.raises(KeyboardInterrupt):
        robot.execute(scene.grasp(), scene.frame)
    assert scene.lab.stops == 1


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
