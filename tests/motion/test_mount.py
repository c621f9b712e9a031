"""Arms that do not stand at the world's origin, and grippers on couplings."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import make_transform
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.arm import ArmMotion, GraspMotion
from thinkgrasp.motion.cell import HOME_RAD, STATICS, StaticBox
from thinkgrasp.motion.collision import PlanningWorld
from thinkgrasp.motion.height_map import HeightMap
from thinkgrasp.motion.mount import ArmMount
from thinkgrasp.motion.robotiq_2f85 import flange_to_tip

HOME = np.array(HOME_RAD)
DOWN = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.5, 0.05, 0.03]))
NO_CLOUD = np.zeros((0, 3))


def yaw(angle: float, xyz: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return make_transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array(xyz, float))


def planned(mount: ArmMount, T_world_tcp: np.ndarray) -> GraspMotion:
    table = StaticBox("table", (mount.T_world_base[0, 3], mount.T_world_base[1, 3], -0.02), (1.2, 1.2, 0.02))
    world = PlanningWorld([table], mount=mount, map=HeightMap((-0.5, 1.5), (-0.5, 1.5)))
    plan = ArmMotion(world).plan_grasp(HOME, T_world_tcp, 0.05, NO_CLOUD)
    assert isinstance(plan, GraspMotion), plan
    return plan


@pytest.mark.parametrize("base", [yaw(0.0, (0.2, -0.1, 0.02)), yaw(1.9, (0.4, 0.3, 0.01))], ids=["moved", "turned"])
@pytest.mark.parametrize("coupling", [np.eye(4), yaw(0.4, (0, 0, 0.014))], ids=["bare", "coupling"])
def test_the_fingertips_come_to_where_the_grasp_is_in_the_world(base, coupling):
    mount = ArmMount(base, coupling)
    T = base @ DOWN
    q = planned(mount, T).approach.end
    reached = mount.in_world(ur5e.forward(q)) @ flange_to_tip(0.05)
    np.testing.assert_allclose(reached[:3, 3], T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(reached[:3, 2], T[:3, 2], atol=1e-6)
    assert abs(reached[:3, 0] @ T[:3, 0]) == pytest.approx(1, abs=1e-6), "either way round"


def test_the_model_stands_where_the_base_is():
    mount = ArmMount(yaw(0.7, (0.3, -0.2, 0.1)), yaw(0.0, (0, 0, 0.02)))
    world = PlanningWorld(STATICS[:0], mount=mount)
    tip = mount.in_world(ur5e.forward(HOME)) @ flange_to_tip(0.085)
    palm = tip[:3, 3] - 0.10 * tip[:3, 2]
    eye = palm + np.array([0.0, 0.0, 0.5])
    along = world.robot_along(HOME, 0.085, eye, np.array([[0, 0, -1.0], [0, 0, 1.0]]))
    assert 0.2 < along[0] < 0.5, "straight down onto palm or wrist"
    assert np.isinf(along[1])


def test_a_post_in_the_world_blocks_the_arm_that_stands_there():
    post = StaticBox("post", (0.5, 0.5, 0.5), (0.03, 0.03, 0.5))
    mount = ArmMount(yaw(0.0, (0.5, 0.45, 0.0)))
    assert PlanningWorld([post], mount=mount).collides(HOME[None], 0.05)[0]
    assert not PlanningWorld([post]).collides(HOME[None], 0.05)[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"T_world_base": np.diag([1.0, -1, -1, 1])}, "may turn about z only"),
        ({"T_world_base": np.full((4, 4), np.nan)}, "finite 4x4"),
        ({"T_world_base": np.eye(3)}, "finite 4x4"),
        ({"T_world_base": np.diag([1.0, 1, 2, 1])}, "orthonormal"),
        ({"T_flange_gripper": yaw(0, (0.01, 0, 0))}, "may move along z only"),
    ],
)
def test_mounts_that_are_not_supported(settings, message):
    with pytest.raises(ConfigError, match=message):
        ArmMount(**settings)
