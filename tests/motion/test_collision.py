from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.motion import ur5e
from thinkgrasp.motion.arm_spec import add_arm
from thinkgrasp.motion.cell import HOME_RAD, STATICS, StaticBox
from thinkgrasp.motion.collision import CarriedBox, PlanningWorld
from thinkgrasp.motion.robotiq_2f85 import STROKE_M
from thinkgrasp.motion.straight import flange_poses

DROP_RAD = (-2.39, -0.95, 0.95, -1.57, -1.57, -2.39)
"""Over the middle of the bin."""

mujoco = pytest.importorskip("mujoco", reason="needs the sim extra")

HOME = np.array(HOME_RAD)


def reach_down(x: float, y: float, z: float, opening_m: float = STROKE_M) -> np.ndarray:
    """Joint angles (6,) with the fingertips there, pointing straight down."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = x, y, z
    q = ur5e.LIMITS.nearest_to(HOME, ur5e.inverse(flange_poses(T[None], np.array([opening_m])))[0])
    return q[np.nanargmin(np.abs(q - HOME).max(axis=1))]


def block(x: float, y: float, height: float, half: float = 0.02) -> np.ndarray:
    """Points (P, 3) all over a square block on the table."""
    side = np.linspace(-half, half, 15)
    grid = np.stack(np.meshgrid(side, side, np.linspace(0, height, 10)), axis=-1).reshape(-1, 3)
    return grid + np.array([x, y, 0.0])


@pytest.fixture(scope="module")
def world() -> PlanningWorld:
    return PlanningWorld()


@pytest.fixture(autouse=True)
def nothing_seen(world: PlanningWorld) -> None:
    world.carry(None)
    world.see(np.zeros((0, 3)))


def test_the_model_has_the_arms_kinematics() -> None:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arm(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        T = ur5e.forward(q)
        np.testing.assert_allclose(data.body("gripper").xpos, T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.body("gripper").xmat.reshape(3, 3), T[:3, :3], atol=1e-9)


@pytest.mark.parametrize("q", [HOME_RAD, DROP_RAD], ids=["home", "drop"])
@pytest.mark.parametrize("opening_m", [0.0, STROKE_M])
def test_the_arms_own_places_are_clear(world: PlanningWorld, q: tuple[float, ...], opening_m: float) -> None:
    assert world.contacts(np.array(q), opening_m) == ()


def test_the_table_is_met_where_it_is(world: PlanningWorld) -> None:
    q = np.stack([reach_down(0.5, 0.0, z) for z in (-0.004, 0.004, 0.02)])
    np.testing.assert_array_equal(world.collides(q, STROKE_M, "contact"), [True, False, False])
    np.testing.assert_array_equal(world.collides(q, STROKE_M, "transfer"), [True, True, False])  # 1 cm of clearance


def test_a_folded_arm_meets_itself(world: PlanningWorld) -> None:
    assert world.collides(np.array([[0.0, -1.57, 2.75, 0.3, 0.0, 0.0]]), STROKE_M).all()


def test_the_cloud_is_an_obstacle_until_it_is_replaced(world: PlanningWorld) -> None:
    q = reach_down(0.5, 0.0, 0.05)[None]
    assert not world.collides(q, STROKE_M).any()
    world.see(block(0.5, 0.0, 0.12, half=0.05))
    assert world.collides(q, STROKE_M).any()
    world.see(block(0.5, 0.2, 0.12, half=0.05))
    assert not world.collides(q, STROKE_M).any()


def test_in_contact_the_gripper_may_meet_the_cloud_and_the_arm_may_not(world: PlanningWorld) -> None:
    q = reach_down(0.5, 0.0, 0.05)[None]
    world.see(block(0.5, 0.0, 0.12, half=0.05))
    assert not world.collides(q, STROKE_M, "contact").any()
    world.see(block(0.5, 0.0, 0.30, half=0.04))  # up to the wrist
    assert world.collides(q, STROKE_M, "contact").any()


def test_the_opening_counts(world: PlanningWorld) -> None:
    world.see(block(0.56, 0.0, 0.15, half=0.005))
    q = reach_down(0.5, 0.0, 0.06, 0.0)[None]
    assert not world.collides(q, 0.0).any()
    assert world.collides(q, STROKE_M).any()


def test_the_arm_is_no_obstacle_to_itself(world: PlanningWorld) -> None:
    forearm = ur5e.link_frames(HOME)[1:3, :3, 3]
    on_it = forearm[0] + np.random.default_rng(0).uniform(0, 1, (4000, 1)) * (forearm[1] - forearm[0])
    on_it += np.random.default_rng(1).normal(0, 0.015, on_it.shape)
    beside = block(0.4, -0.1, 0.12)
    world.see(np.concatenate([on_it, beside]))
    assert world.collides(HOME[None], STROKE_M).any()
    world.see(np.concatenate([on_it, beside]), arm_at=HOME)
    assert not world.collides(HOME[None], STROKE_M).any()
    assert world.collides(reach_down(0.4, -0.1, 0.03)[None], STROKE_M).any()


def test_what_is_carried_collides_until_it_is_let_go(world: PlanningWorld) -> None:
    q = reach_down(0.5, 0.0, 0.10)[None]
    hanging = np.eye(4)
    hanging[2, 3] = 0.20
    world.carry(CarriedBox(hanging, (0.02, 0.02, 0.03)))
    world.see(block(0.5, 0.0, 0.05))
    assert world.collides(q, 0.04).all()
    assert any("carried" in pair for pair in world.contacts(q[0], 0.04))
    assert not world.collides(q - 0.4 * np.eye(6)[0], 0.04).any()
    world.carry(None)
    assert not world.collides(q, 0.04).any()


def test_other_boxes_can_stand_around() -> None:
    q = reach_down(0.5, 0.0, 0.3)[None]
    assert not PlanningWorld(STATICS).collides(q, STROKE_M).any()
    shelf = StaticBox("shelf", (0.5, 0.0, 0.42), (0.1, 0.1, 0.01))
    assert "gripper - shelf" in PlanningWorld((*STATICS, shelf)).contacts(q[0], STROKE_M)


def test_nothing_asked_nothing_answered(world: PlanningWorld) -> None:
    assert world.collides(np.zeros((0, 6)), STROKE_M).shape == (0,)
