from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import look, top_down
from fakes.things import ball, box

from thinkgrasp import testing
from thinkgrasp.errors import InputError
from thinkgrasp.interfaces import Robot
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.robots.simulated import STOP_FORCE_N, SimulatedRobot, perceived_cloud
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Outcome

RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.2, 0.8)
BLOCK, BALL = box((0.04, 0.06, 0.05), RED), ball(0.03, BLUE)
HEAVY = replace(BLOCK, mass_kg=8.0)
GOOD = top_down(0.5, 0.0, 0.02, width=0.054)


def table(*objects: tuple[SimObject, np.ndarray]) -> World:
    """A world at rest with these on its table."""
    world = World([obj for obj, _ in objects])
    for index, (_, T) in enumerate(objects):
        world.place(index, T)
    assert world.settle()
    return world


def is_home(world: World) -> bool:
    return bool(np.abs(world.joints() - HOME_RAD).max() < 0.01 and world.opening() > 0.08)


# -- outcomes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("thing", "T", "grasp"),
    [
        (BLOCK, pose(0.5, 0.0, 0.025), GOOD),
        (BLOCK, pose(0.4, -0.15, 0.025, 0.6), top_down(0.4, -0.15, 0.02, width=0.054, yaw=0.6)),
        (BALL, pose(0.5, 0.05, 0.03), top_down(0.5, 0.05, 0.025, width=0.075)),
        (BALL, pose(0.6, 0.1, 0.03), top_down(0.6, 0.1, 0.025, width=0.075, yaw=1.2)),
    ],
    ids=["box", "turned box", "ball", "ball elsewhere"],
)
def test_holds_and_delivers(thing, T, grasp):
    world = table((thing, T))
    robot = SimulatedRobot(world)
    assert isinstance(robot, Robot)
    assert robot.execute(grasp, look(world)) == Outcome(True, "held")
    assert robot.truth.touched == robot.truth.delivered == 0
    assert world.settle()
    assert world.in_bin(0)
    assert is_home(world)


def test_a_grasp_beside_the_thing_misses():
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    robot = SimulatedRobot(world)
    assert robot.execute(top_down(0.5, 0.12, 0.02, width=0.05), look(world)) == Outcome(False, "missed")
    assert robot.truth.touched is None
    np.testing.assert_allclose(world.center(0), [0.5, 0.0, 0.025], atol=1e-3)
    assert is_home(world)


@pytest.mark.parametrize("place", [(1.4, 0.0, 0.02), (0.0, 0.0, 0.05), (-5.0, 3.0, 0.1)])
def test_what_is_out_of_reach_is_not_tried(place):
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    robot = SimulatedRobot(world)
    before, frame = world.time_s, look(world)
    assert robot.execute(top_down(*place, width=0.05), frame) == Outcome(False, "unreachable")
    assert world.time_s == before
    assert is_home(world)


def test_a_thing_that_was_not_seen_stops_the_fingers():
    """The frame shows an empty table; under one finger there is something too heavy to push away."""
    world = World([HEAVY])
    frame = look(world)
    world.place(0, pose(0.5, 0.0, 0.025))
    world.settle()
    robot = SimulatedRobot(world)
    assert robot.execute(top_down(0.53, 0.0, 0.02, width=0.054), frame) == Outcome(False, "collision")
    assert robot.truth.touched is None
    np.testing.assert_allclose(world.center(0), [0.5, 0.0, 0.025], atol=0.02)
    assert is_home(world)


class FeelingWorld(World):
    """Notes how hard the robot presses on anything."""

    def __init__(self, objects: Sequence[SimObject]) -> None:
        self.forces: list[float] = []
        super().__init__(objects)

    def step(self, n: int = 1) -> None:
        super().step(n)
        self.forces.append(self.collision_force())


def hidden_wall() -> tuple[FeelingWorld, Frame]:
    """A block, and across the way to it a wall of 30 kg that the frame does not show."""
    world = FeelingWorld([BLOCK, replace(box((0.30, 0.03, 0.50), BLUE), mass_kg=30.0)])
    world.place(0, pose(0.5, 0.0, 0.025))
    frame = look(world)
    world.place(1, pose(0.4, 0.3, 0.25))
    return world, frame


def test_a_thing_that_was_not_seen_stops_the_arm():
    world, frame = hidden_wall()
    robot = SimulatedRobot(world)
    assert robot.execute(GOOD, frame) == Outcome(False, "collision")
    assert robot.truth.touched is None
    assert is_home(world)


def test_a_stopped_arm_does_not_push_on():
    world, frame = hidden_wall()
    assert SimulatedRobot(world).execute(GOOD, frame).reason == "collision"
    assert sum(force > STOP_FORCE_N for force in world.forces) == 1  # where it was stopped, and never again


def test_what_is_too_heavy_slips():
    world = table((HEAVY, pose(0.5, 0.0, 0.025)))
    robot = SimulatedRobot(world)
    assert robot.execute(GOOD, look(world)) == Outcome(False, "slipped")
    assert robot.truth.touched == 0
    assert robot.truth.delivered is None
    assert world.on_table(0)
    assert is_home(world)


def test_with_less_force_it_slips_sooner():
    light, strong = (table((replace(BLOCK, mass_kg=2.0), pose(0.5, 0.0, 0.025))) for _ in range(2))
    assert SimulatedRobot(strong).execute(GOOD, look(strong)).reason == "held"
    assert SimulatedRobot(light, force_n=10.0).execute(GOOD, look(light)).reason == "slipped"


def test_what_was_taken_is_known_from_contacts():
    """The grasp is meant for nothing in particular; between the fingers stands the second of three things."""
    world = table(
        (BALL, pose(0.4, 0.15, 0.03)),
        (BLOCK, pose(0.5, 0.0, 0.025)),
        (BALL, pose(0.6, -0.15, 0.03)),
    )
    robot = SimulatedRobot(world)
    assert robot.execute(GOOD, look(world)).success
    assert robot.truth.touched == robot.truth.delivered == 1
    assert robot.execute(GOOD, look(world)).reason == "missed"
    assert robot.truth.touched is None  # of this attempt, not of the one before


class NoWayToTheBin(ArmMotion):
    def plan_to_poses(self, *args, **kwargs):
        return "no path"


class NoWayHome(ArmMotion):
    def plan_to(self, *args, **kwargs):
        return "no path"


def test_without_a_way_to_the_bin_it_is_let_go():
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    robot = SimulatedRobot(world, NoWayToTheBin())
    assert robot.execute(GOOD, look(world)) == Outcome(False, "unreachable")
    assert robot.truth.touched == 0
    assert robot.truth.delivered is None
    assert world.on_table(0)
    assert is_home(world)


def test_without_a_planned_way_home_it_goes_straight():
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    robot = SimulatedRobot(world, NoWayHome())
    assert robot.execute(top_down(0.5, 0.12, 0.02, width=0.05), look(world)).reason == "missed"
    assert is_home(world)


def test_someone_may_watch():
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    times: list[float] = []
    robot = SimulatedRobot(world)
    robot.watchers.append(lambda: times.append(world.time_s))
    robot.execute(GOOD, look(world))
    assert len(times) > 20
    np.testing.assert_allclose(np.diff(times), 0.1, atol=0.11)


def test_wrong_use_is_refused():
    with pytest.raises(InputError, match="without a robot"):
        SimulatedRobot(World([], robot=False))
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    frame = replace(look(world), T_world_camera=None)
    with pytest.raises(InputError, match="T_world_camera"):
        SimulatedRobot(world).execute(GOOD, frame)
    with pytest.raises(InputError, match="T_world_camera"):
        perceived_cloud(frame)


def test_keeps_the_contract_of_robots():
    testing.check_robot(SimulatedRobot(World([])))


# -- motion follows what is seen, not what is there ------------------------------------------------------------------


def frame_with(ghost: SimObject, T: np.ndarray) -> Frame:
    """What the camera would see if there were also a thing that is not there."""
    world = World([BLOCK, ghost])
    world.place(0, pose(0.5, 0.0, 0.025))
    world.place(1, T)
    return look(world)


def flange_path(world: World, frame: Frame) -> tuple[Outcome, np.ndarray]:
    path: list[np.ndarray] = []
    robot = SimulatedRobot(world)
    robot.watchers.append(lambda: path.append(world.flange()[:3, 3]))
    return robot.execute(GOOD, frame), np.array(path)


def test_what_the_frame_shows_blocks_though_it_is_not_there():
    world = table((BLOCK, pose(0.5, 0.0, 0.025)))
    frame = frame_with(box((0.30, 0.30, 0.02), BLUE), pose(0.5, 0.0, 0.30))
    assert SimulatedRobot(world).execute(GOOD, frame) == Outcome(False, "unreachable")
    assert SimulatedRobot(world).execute(GOOD, look(world)) == Outcome(True, "held")


def test_what_the_frame_shows_is_gone_around():
    ghost = box((0.30, 0.03, 0.24), BLUE)
    frame = frame_with(ghost, pose(0.45, 0.20, 0.12))
    seen = perceived_cloud(frame)
    wall = seen[(seen[:, 1] > 0.18) & (seen[:, 1] < 0.22) & (seen[:, 2] > 0.2)]
    assert len(wall) > 20
    outcomes, lowest = [], []
    for way in (look(table((BLOCK, pose(0.5, 0.0, 0.025)))), frame):
        world = table((BLOCK, pose(0.5, 0.0, 0.025)))
        outcome, path = flange_path(world, way)
        outcomes.append(outcome)
        over = path[(np.abs(path[:, 1] - 0.20) < 0.1) & (path[:, 0] > 0.28) & (path[:, 0] < 0.62)]
        lowest.append(over[:, 2].min() if len(over) else np.inf)
    assert outcomes == [Outcome(True, "held")] * 2
    assert lowest[1] > 0.24 + 0.14  # fingers above the wall, or not over it at all
    assert lowest[0] < lowest[1]
