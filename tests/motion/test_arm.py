from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import HOME_RAD

pytest.importorskip("mujoco", reason="needs the sim extra")

from thinkgrasp.motion.arm import ArmMotion, GraspMotion
from thinkgrasp.motion.collision import CarriedBox
from thinkgrasp.motion.robotiq_2f85 import flange_to_tip
from thinkgrasp.motion.trajectory import Trajectory

DROP_RAD = (-2.39, -0.95, 0.95, -1.57, -1.57, -2.39)
"""Over the middle of the bin."""

HOME, DROP = np.array(HOME_RAD), np.array(DROP_RAD)
NOTHING = np.zeros((0, 3))
OPENING_M = 0.06


def grasp_at(x: float, y: float, z: float, tilt: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """T_world_tcp: down onto the table, turned about the vertical, then tilted about the world's y."""
    down = np.diag([1.0, -1.0, -1.0])
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(tilt), np.sin(tilt)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ turn @ down
    T[:3, 3] = x, y, z
    return T


def tips(q: np.ndarray, opening_m: float = OPENING_M) -> np.ndarray:
    return ur5e.forward(q) @ flange_to_tip(opening_m)


def wall(x: tuple[float, float], y: float, height: float) -> np.ndarray:
    line, up = np.arange(*x, 0.004), np.arange(0, height, 0.02)
    points = np.stack(np.meshgrid(line, [y - 0.01, y, y + 0.01], up), axis=-1).reshape(-1, 3)
    return np.repeat(points, 2, axis=0)


@pytest.fixture(scope="module")
def arm() -> ArmMotion:
    return ArmMotion()


def planned(plan: GraspMotion | str) -> GraspMotion:
    assert isinstance(plan, GraspMotion), plan
    return plan


GRASPS = {
    "middle": grasp_at(0.5, 0.0, 0.02),
    "near right": grasp_at(0.30, -0.20, 0.05, yaw=1.0),
    "far left": grasp_at(0.70, 0.20, 0.02, yaw=2.0),
    "tilted": grasp_at(0.5, 0.1, 0.06, tilt=0.6, yaw=0.4),
}


@pytest.mark.parametrize("T", GRASPS.values(), ids=[n.replace(" ", "-") for n in GRASPS])
def test_a_grasp_is_reached_straight_and_lifted_straight(arm: ArmMotion, T: np.ndarray) -> None:
    plan = planned(arm.plan_grasp(HOME, T, OPENING_M, NOTHING))
    np.testing.assert_allclose(plan.to_pregrasp.start, HOME, atol=1e-9)
    np.testing.assert_allclose(plan.to_pregrasp.end, plan.approach.start, atol=1e-9)
    np.testing.assert_allclose(plan.approach.end, plan.lift.start, atol=1e-9)

    reached = tips(plan.approach.end)
    np.testing.assert_allclose(reached[:3, 3], T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(reached[:3, 2], T[:3, 2], atol=1e-6)
    assert abs(abs(reached[:3, 0] @ T[:3, 0]) - 1) < 1e-6  # a half turn is the same grasp

    off_line = tips(plan.approach.positions)[:, :3, 3] - T[:3, 3]
    along = off_line @ T[:3, 2]
    assert along[0] == pytest.approx(-arm.standoff_m, abs=1e-6)
    assert np.linalg.norm(off_line - along[:, None] * T[:3, 2], axis=1).max() < 0.001
    lifted = tips(plan.lift.positions)[:, :3, 3] - T[:3, 3]
    assert lifted[-1, 2] == pytest.approx(arm.lift_m, abs=1e-6)
    assert np.abs(lifted[:, :2]).max() < 0.001


@pytest.mark.parametrize("T", GRASPS.values(), ids=[n.replace(" ", "-") for n in GRASPS])
def test_nothing_is_touched_on_the_way(arm: ArmMotion, T: np.ndarray) -> None:
    cloud = wall((0.2, 0.7), 0.32, 0.25)
    plan = planned(arm.plan_grasp(HOME, T, OPENING_M, cloud))
    assert not arm.world.collides(plan.approach.positions, OPENING_M, "contact").any()
    assert not arm.world.collides(plan.lift.positions, OPENING_M, "contact").any()
    assert arm.world.collides(plan.to_pregrasp.positions, OPENING_M).mean() < 0.05  # corners are rounded into clearance
    for motion in (plan.to_pregrasp, plan.approach, plan.lift):
        assert ur5e.LIMITS.contain(motion.positions).all()


def test_a_wall_is_gone_around(arm: ArmMotion) -> None:
    T = grasp_at(0.5, 0.0, 0.02)
    free = planned(arm.plan_grasp(HOME, T, OPENING_M, NOTHING)).to_pregrasp
    around = planned(arm.plan_grasp(HOME, T, OPENING_M, wall((0.2, 0.75), 0.30, 0.45))).to_pregrasp
    assert around.duration_s > free.duration_s


def test_same_question_same_answer(arm: ArmMotion) -> None:
    question = HOME, grasp_at(0.5, 0.0, 0.02), OPENING_M, wall((0.2, 0.75), 0.30, 0.45)
    first = planned(arm.plan_grasp(*question))
    arm.plan_grasp(HOME, grasp_at(0.6, 0.1, 0.05), OPENING_M, NOTHING)
    second = planned(arm.plan_grasp(*question))
    np.testing.assert_array_equal(first.to_pregrasp.positions, second.to_pregrasp.positions)


@pytest.mark.parametrize(
    ("T", "cloud", "reason"),
    [
        pytest.param(grasp_at(1.3, 0.0, 0.1), NOTHING, "no inverse kinematics", id="too far"),
        pytest.param(grasp_at(0.5, 0.0, -0.05), NOTHING, "approach in collision", id="below the table"),
        pytest.param(
            grasp_at(0.5, 0.0, 0.02),
            np.concatenate([wall((0.38, 0.62), y, 0.9) for y in np.arange(-0.12, 0.13, 0.02)]),
            "approach in collision",
            id="inside a tower",
        ),
        pytest.param(
            grasp_at(0.5, 0.0, 0.02),
            np.concatenate([wall((0.15, 1.05), y, 1.0) for y in (0.28, 0.30)]),
            "no path",
            id="behind a wall to the ceiling",
        ),
    ],
)
def test_no_motion_has_a_reason(arm: ArmMotion, T: np.ndarray, cloud: np.ndarray, reason: str) -> None:
    assert arm.plan_grasp(HOME, T, OPENING_M, cloud) == reason


def test_reaches_agrees_with_planning(arm: ArmMotion) -> None:
    rng = np.random.default_rng(0)
    T = np.stack(
        [
            grasp_at(
                *rng.uniform([0.2, -0.3, 0.0], [1.0, 0.3, 0.1]), tilt=rng.uniform(-1.5, 1.5), yaw=rng.uniform(0, 3)
            )
            for _ in range(40)
        ]
    )
    cloud = wall((0.4, 0.6), 0.05, 0.15)
    says = arm.reaches(HOME, T, np.full(40, OPENING_M), cloud)
    does = [isinstance(arm.plan_grasp(HOME, t, OPENING_M, cloud), GraspMotion) for t in T]
    assert 5 < says.sum() < 40
    assert (says == does).mean() >= 0.95


def test_reaches_stops_when_enough_are_found(arm: ArmMotion) -> None:
    T = np.stack([grasp_at(0.5, 0.0, 0.02)] * 5)
    found = arm.reaches(HOME, T, np.full(5, OPENING_M), NOTHING, at_most=2)
    np.testing.assert_array_equal(found, [True, True, False, False, False])


def test_transfer_to_the_bin_with_something_in_hand(arm: ArmMotion) -> None:
    lifted = planned(arm.plan_grasp(HOME, grasp_at(0.5, 0.0, 0.05), OPENING_M, NOTHING)).lift.end
    held = np.eye(4)
    held[2, 3] = 0.16
    carried = CarriedBox(held, (0.02, 0.02, 0.05))
    way = arm.plan_to(lifted, DROP, 0.04, NOTHING, carried)
    assert isinstance(way, Trajectory)
    np.testing.assert_allclose(way.start, lifted, atol=1e-9)
    np.testing.assert_allclose(way.end, DROP, atol=1e-9)
    home = arm.plan_to(DROP, HOME, OPENING_M, NOTHING)
    assert isinstance(home, Trajectory)
    np.testing.assert_allclose(home.end, HOME, atol=1e-9)


def test_a_start_among_things_is_left_upwards(arm: ArmMotion) -> None:
    low = planned(arm.plan_grasp(HOME, grasp_at(0.5, 0.0, 0.02), OPENING_M, NOTHING)).approach.end
    around = np.concatenate([wall((0.45, 0.55), y, 0.08) for y in (-0.05, 0.0, 0.05)])
    way = arm.plan_to(low, HOME, OPENING_M, around)
    assert isinstance(way, Trajectory)
    path = tips(way.positions)[:, :3, 3]
    below = path[path[:, 2] < 0.06]
    assert np.abs(below[:, :2] - [0.5, 0.0]).max() < 0.01
    np.testing.assert_allclose(way.end, HOME, atol=1e-9)


def test_transfer_to_any_of_several_poses(arm: ArmMotion) -> None:
    poses = np.stack([grasp_at(0.45, 0.6, 0.35, yaw=yaw) for yaw in np.linspace(0, np.pi, 4)])
    way = arm.plan_to_poses(HOME, poses, OPENING_M, NOTHING)
    assert isinstance(way, Trajectory)
    assert np.abs(poses - tips(way.end)).max(axis=(1, 2)).min() < 1e-6
    poses[:, 0, 3] += 3
    assert arm.plan_to_poses(HOME, poses, OPENING_M, NOTHING) == "no inverse kinematics"


def test_direct_goes_straight_whatever_is_there(arm: ArmMotion) -> None:
    motion = arm.direct(HOME, DROP)
    share = (motion.positions - HOME) @ (DROP - HOME) / ((DROP - HOME) @ (DROP - HOME))
    np.testing.assert_allclose(motion.positions, HOME + share[:, None] * (DROP - HOME), atol=1e-9)


@pytest.mark.parametrize("setting", [{"standoff_m": 0.0}, {"lift_m": 1.0}, {"straight_speed": 2.0}])
def test_settings_out_of_range(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="arm motion"):
        ArmMotion(**setting)  # type: ignore[arg-type]
