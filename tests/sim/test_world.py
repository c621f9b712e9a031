from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import look, top_down  # noqa: E402
from fakes.things import ball, box, hammer, piece  # noqa: E402

from thinkgrasp.errors import InputError  # noqa: E402
from thinkgrasp.geometry import apply, invert  # noqa: E402
from thinkgrasp.motion import robotiq_2f85 as linkage  # noqa: E402
from thinkgrasp.motion import ur5e  # noqa: E402
from thinkgrasp.motion.arm_spec import PADS  # noqa: E402
from thinkgrasp.motion.cell import BIN, HOME_RAD  # noqa: E402
from thinkgrasp.motion.trajectory import time_path  # noqa: E402
from thinkgrasp.robots.simulated import SimulatedRobot  # noqa: E402
from thinkgrasp.sim.objects import CollisionPiece, SimObject  # noqa: E402
from thinkgrasp.sim.rays import cast  # noqa: E402
from thinkgrasp.sim.tabletop import pose  # noqa: E402
from thinkgrasp.sim.views import CameraView, default_view, side_view  # noqa: E402
from thinkgrasp.sim.world import COLLISION_GROUP, GRIP_FORCE_N, TIMESTEP_S, World  # noqa: E402

RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.2, 0.8)
BLOCK = box((0.04, 0.06, 0.05), RED)
HOME = np.array(HOME_RAD)


def hull(points: np.ndarray) -> SimObject:
    return replace(BLOCK, name="odd", collisions=(CollisionPiece("hull", points_m=points),))


# -- objects ---------------------------------------------------------------------------------------------------------


def test_objects_have_the_mass_and_friction_that_were_given():
    objects = [BLOCK, replace(ball(0.03, BLUE), mass_kg=0.75, friction=0.9), hammer(RED, BLUE)]
    world = World(objects, robot=False)
    for index, obj in enumerate(objects):
        body = world.model.body(f"object_{index}").id
        assert world.model.body_mass[body] == pytest.approx(obj.mass_kg)
        collisions = np.flatnonzero((world.object_of_geom == index) & (world.model.geom_contype > 0))
        assert len(collisions) == len(obj.collisions)
        assert world.model.geom_friction[collisions, 0] == pytest.approx(obj.friction)
    sphere = world.model.body_inertia[world.model.body("object_1").id]
    assert sphere == pytest.approx(0.4 * 0.75 * 0.03**2, rel=1e-6)


@pytest.mark.parametrize("friction", [0.5, 0.8])
def test_a_thing_slides_as_far_as_its_friction_lets_it(friction):
    world = World([replace(box((0.10, 0.10, 0.02), RED), friction=friction)], robot=False)
    world.place(0, pose(0.3, 0.0, 0.01))
    world.settle()
    world.data.qvel[0] = speed = 1.0
    world.step(500)
    assert world.center(0)[0] - 0.3 == pytest.approx(speed**2 / (2 * friction * 9.81), rel=0.1)


def test_visual_pieces_are_known_by_their_geoms_and_touch_nothing():
    thing = hammer(RED, BLUE)
    world = World([BLOCK, thing], robot=False)
    assert [world.visuals[g] for g in sorted(world.visuals)] == [*BLOCK.visuals, *thing.visuals]
    assert [world.object_of_geom[g] for g in sorted(world.visuals)] == [0, 1, 1]
    assert not world.model.geom_contype[list(world.visuals)].any()
    assert world.object_of_geom[world.model.geom("table").id] == -1


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.zeros((8, 3)), np.eye(4)[:, :3] * [1.0, 1.0, 0.0]])
def test_a_hull_that_is_none_is_refused(points):
    with pytest.raises(InputError):
        World([hull(points)])


def test_a_hull_is_where_its_points_are():
    corners = np.array([[x, y, z] for x in (0.0, 0.04) for y in (0.0, 0.04) for z in (0.0, 0.04)])
    visual = piece(pytest.importorskip("trimesh").convex.convex_hull(corners), RED)
    world = World([replace(hull(corners), visuals=(visual,))], robot=False)
    world.place(0, pose(0.5, 0.0, 0.0))
    assert world.settle()
    np.testing.assert_allclose(world.pose(0), pose(0.5, 0.0, 0.0), atol=1e-3)
    np.testing.assert_allclose(world.center(0), [0.52, 0.02, 0.02], atol=1e-3)


def test_objects_are_where_they_are_put():
    world = World([BLOCK, BLOCK], robot=False)
    assert world.is_parked(0)
    assert not world.on_table(0)
    T = pose(0.4, -0.1, 0.2, 0.7)
    T[:3, :3] = T[:3, :3] @ pose(0, 0, 0, 0.3)[:3, [2, 0, 1]]
    world.place(0, T)
    np.testing.assert_allclose(world.pose(0), T, atol=1e-12)
    np.testing.assert_array_equal(world.poses()[0], world.pose(0))
    np.testing.assert_allclose(world.data.body("object_0").xpos, T[:3, 3])
    np.testing.assert_allclose(world.data.body("object_0").xmat.reshape(3, 3), T[:3, :3], atol=1e-12)
    assert world.is_parked(1)
    world.park(0)
    assert world.is_parked(0)


def test_what_is_out_of_the_world_stays_there():
    world = World([BLOCK, ball(0.03, BLUE)], robot=False)
    before = world.poses()
    world.step(1000)
    np.testing.assert_allclose(world.poses(), before, atol=1e-9)
    assert world.at_rest()


def test_things_fall_and_come_to_rest():
    world = World([BLOCK, ball(0.03, BLUE)], robot=False)
    assert world.drop([(0, pose(0.5, 0.0, 0.10)), (1, pose(0.4, 0.1, 0.15))])
    assert world.at_rest()
    assert world.center(0)[2] == pytest.approx(0.025, abs=1e-3)
    assert world.center(1)[2] == pytest.approx(0.030, abs=1e-3)
    assert world.on_table(0)
    assert world.on_table(1)
    assert max(world.speed(0)) < 0.2
    assert world.time_s > 2 * 0.15


def test_rays_are_cast_again_only_where_something_has_moved():
    world = World([BLOCK], robot=False)
    world.place(0, pose(0.5, 0.0, 0.025))
    near, other = default_view("l515", (224, 224)), side_view("l515", (224, 224))
    first = world.hits(near)
    assert world.hits(CameraView(near.intrinsics, near.T_world_camera.copy())) is first
    assert not np.array_equal(world.hits(other).geoms, first.geoms)
    assert world.hits(near) is first
    assert not any(array.flags.writeable for array in (first.geoms, first.distances, first.normals))

    world.place(0, pose(0.5, 0.1, 0.025))
    moved = world.hits(near)
    fresh = cast(world.model, world.data, near.eye, near.rays, normals=True)
    np.testing.assert_array_equal(moved.geoms, fresh.geoms)
    np.testing.assert_array_equal(moved.distances, fresh.distances)
    assert not np.array_equal(moved.geoms, first.geoms)
    world.model.geom_group[:] = COLLISION_GROUP
    assert (world.hits(near).geoms == -1).all()


def test_settling_gives_up_in_time():
    world = World([BLOCK], robot=False)
    world.place(0, pose(0.5, 0.0, 3.0))
    assert not world.settle(max_seconds=0.2)
    assert world.time_s == pytest.approx(0.2)


def test_what_sleeps_wakes_when_the_world_around_it_changes():
    world = World([BLOCK, BLOCK, BLOCK], robot=False)
    world.place(0, pose(0.5, 0.0, 0.025))
    world.place(1, pose(0.5, 0.0, 0.075))
    world.step(2000)
    world.park(0)
    world.step(500)
    assert world.center(1)[2] == pytest.approx(0.025, abs=1e-3)  # what it lay on is gone
    world.step(2000)
    world.place(1, pose(0.4, 0.0, 0.3))
    world.step(500)
    assert world.center(1)[2] == pytest.approx(0.025, abs=1e-3)  # put in the air, it falls
    world.place(2, pose(0.4, 0.0, 0.2))
    world.step(500)
    assert world.center(2)[2] == pytest.approx(0.075, abs=1e-3)  # and bears what falls on it


@pytest.mark.parametrize(
    ("place", "in_bin", "on_table"),
    [
        ((0.5, 0.0, 0.025), False, True),
        ((0.5, 0.0, 0.5), False, True),
        ((BIN.x_m[0] + 0.05, BIN.y_m[0] + 0.05, 0.025), True, False),
        ((BIN.x_m[0] + 0.05, BIN.y_m[0] + 0.05, 0.50), False, True),  # carried over it is not in it
        ((0.5, 0.0, -0.3), False, False),
        ((1.5, 0.0, 0.025), False, False),
    ],
)
def test_in_the_bin_or_on_the_table(place, in_bin, on_table):
    world = World([BLOCK], robot=False)
    world.place(0, pose(*place))
    assert (world.in_bin(0), world.on_table(0)) == (in_bin, on_table)


def test_the_bin_keeps_what_falls_into_it():
    world = World([ball(0.03, BLUE)], robot=False)
    world.drop([(0, pose(np.mean(BIN.x_m), np.mean(BIN.y_m), 0.3))])
    assert world.in_bin(0)


def test_an_empty_world_is_at_rest():
    world = World([], robot=False)
    assert world.settle()
    assert world.poses().shape == (0, 4, 4)


# -- the same again --------------------------------------------------------------------------------------------------

ATTEMPT = "from sim.test_world import hash_of_an_attempt; print(hash_of_an_attempt())"


def hash_of_an_attempt() -> str:
    """Drop, look, grasp, deliver: a digest of everything's position afterwards."""
    world = World([BLOCK, ball(0.03, BLUE), hammer(RED, BLUE)])
    world.drop([(0, pose(0.5, 0.0, 0.1)), (1, pose(0.45, 0.1, 0.1)), (2, pose(0.55, -0.15, 0.1, 0.4))])
    outcome = SimulatedRobot(world).execute(top_down(0.5, 0.0, 0.02, width=0.054), look(world))
    assert outcome.success
    return hashlib.sha256(world.data.qpos.tobytes()).hexdigest()


def test_the_same_commands_give_the_same_bits_in_every_process():
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    digests = {hash_of_an_attempt(), hash_of_an_attempt()}
    for seed in ("1", "2"):
        env = {**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": seed}
        run = subprocess.run([sys.executable, "-c", ATTEMPT], env=env, capture_output=True, text=True, timeout=120)
        assert run.returncode == 0, run.stderr
        digests.add(run.stdout.strip())
    assert len(digests) == 1


# -- gripper ---------------------------------------------------------------------------------------------------------


def pads_in_flange(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Centres (2, 3) and rotations (2, 3, 3) of right and left pad in the flange frame."""
    mujoco.mj_kinematics(world.model, world.data)
    T = invert(world.flange())
    geoms = [world.data.geom(name) for name in PADS]
    return (
        np.array([apply(T, g.xpos) for g in geoms]),
        np.array([T[:3, :3] @ g.xmat.reshape(3, 3) for g in geoms]),
    )


def test_fingertips_move_on_the_linkages_arc():
    world = World([])
    reaches = []
    for commanded in (0.085, 0.06, 0.03, 0.01, 0.0):
        world.command_gripper(commanded)
        world.step(1000)
        centers, rotations = pads_in_flange(world)
        np.testing.assert_allclose(rotations, np.tile(np.eye(3), (2, 1, 1)), atol=1e-6)  # parallel to the palm
        np.testing.assert_allclose(centers[0] * [-1, 1, 1], centers[1], atol=1e-6)  # one like the other
        between = centers[0, 0] - centers[1, 0] - 2 * linkage.PAD_HALF_M[0]
        assert world.opening() == pytest.approx(commanded, abs=1e-6)
        assert between == pytest.approx(commanded, abs=1e-6)
        crank = world.data.joint("right_crank").qpos[0]
        assert crank == pytest.approx(float(linkage.crank_angle(commanded)), abs=1e-6)
        reaches.append(centers[0, 2] + linkage.PAD_HALF_M[2])
    np.testing.assert_allclose(reaches, linkage.tip_reach([0.085, 0.06, 0.03, 0.01, 0.0]), atol=1e-6)
    assert reaches[-1] - reaches[0] == pytest.approx(0.0139, abs=1e-4)


def around(world: World, width: float) -> None:
    """Put the open gripper around a thing of this width at (0.5, 0, 0.03)."""
    T = top_down_tcp(0.5, 0.0, 0.03) @ invert(linkage.flange_to_tip(width))
    q = ur5e.LIMITS.nearest_to(HOME, ur5e.inverse(T[None]).reshape(-1, 6))
    world.set_joints(q[np.isfinite(q).all(axis=1)][0], min(width + 0.012, linkage.STROKE_M))


def squeeze(world: World, force_n: float) -> None:
    """Close slowly and press."""
    opening = world.opening()
    for k in range(40):
        world.command_gripper(max(opening - 0.0015 * k, 0.0), force_n)
        world.step(5)
    world.command_gripper(0.0, force_n)
    world.step(200)


def top_down_tcp(x: float, y: float, z: float) -> np.ndarray:
    T = pose(x, y, z)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    return T


def pad_forces(world: World) -> np.ndarray:
    """Force (2,) [N] that each pad presses with on object 0."""
    total, force = np.zeros(2), np.zeros(6)
    for side, name in enumerate(PADS):
        pad = world.model.geom(name).id
        for i, pair in enumerate(world.data.contact.geom):
            if pad in pair and 0 in world.object_of_geom[pair]:
                mujoco.mj_contactForce(world.model, world.data, i, force)
                total[side] += force[0]
    return total


@pytest.mark.parametrize("width", [0.02, 0.04, 0.07])
@pytest.mark.parametrize("force_n", [20.0, GRIP_FORCE_N])
def test_grip_force_is_limited(width, force_n):
    world = World([replace(box((width, 0.06, 0.06), RED), mass_kg=2.0)])
    world.place(0, pose(0.5, 0.0, 0.03))
    around(world, width)
    squeeze(world, force_n)
    assert world.held() == 0
    assert world.pad_contacts() == [{0}, {0}]
    assert world.opening() == pytest.approx(width, abs=1.5e-3)
    assert pad_forces(world) == pytest.approx([force_n, force_n], rel=0.15)


def test_nothing_is_held_in_empty_air_nor_by_one_finger():
    world = World([BLOCK])
    world.place(0, pose(0.5, 0.0, 0.025))
    around(world, 0.04)
    world.step(5)
    assert world.held() is None
    world.place(0, pose(0.5005 + (world.opening() - 0.04) / 2, 0.0, 0.025))
    world.step(5)
    assert world.pad_contacts() == [{0}, set()]
    assert world.held() is None


# -- arm -------------------------------------------------------------------------------------------------------------


def test_the_flange_is_where_kinematics_says():
    world = World([])
    for q in (HOME, HOME + 0.3, np.array([0.1, -1.2, 1.4, -1.7, -1.5, 0.4])):
        world.set_joints(q, 0.03)
        np.testing.assert_array_equal(world.joints(), q)
        assert world.opening() == pytest.approx(0.03)
        np.testing.assert_allclose(world.flange(), ur5e.forward(q), atol=1e-12)
        world.step(250)
        np.testing.assert_allclose(world.joints(), q, atol=2e-3)  # the servos hold it there


def test_the_arm_follows_a_trajectory():
    world = World([])
    goal = HOME + np.array([0.8, -0.3, 0.4, -0.5, 0.3, -0.9])
    trajectory = time_path(np.stack([HOME, goal]), ur5e.LIMITS)
    lag, dt = [], 5 * TIMESTEP_S
    for k in range(1, int(trajectory.duration_s / dt)):
        at, before = trajectory.sample(k * dt), trajectory.sample((k - 1) * dt)
        world.command(at, (trajectory.sample((k + 1) * dt) - before) / (2 * dt))
        world.step(5)
        lag.append(np.abs(world.joints() - at).max())
    assert max(lag) < 0.02
    assert np.median(lag) < 0.01
    world.command(goal, np.zeros(6))
    world.step(100)
    np.testing.assert_allclose(world.joints(), goal, atol=3e-3)


def test_a_world_without_robot_has_none():
    world = World([BLOCK], robot=False)
    assert not world.has_robot
    assert world.model.nu == 0


def test_what_the_fingers_press_on_is_felt():
    world = World([replace(BLOCK, mass_kg=2.0)])
    assert world.collision_force() == 0.0
    world.place(0, pose(0.5, 0.0, 0.03))
    around(world, 0.04)
    squeeze(world, GRIP_FORCE_N)
    assert world.held() == 0
    assert world.collision_force() > GRIP_FORCE_N / 8  # a pad's force is shared by a few contacts
    world.set_joints(HOME, linkage.STROKE_M)
    world.step(1)
    assert world.collision_force() == 0.0
