"""Goals for MoveIt and the gripper: RRT* by name, the right pose for the right link, and what the answers mean."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.ros import JOINTS, FakeMessages, parameters
from scipy.spatial.transform import Rotation
from thinkgrasp_ros.interface import RobotFault
from thinkgrasp_ros.moveit import (
    FAULTS,
    MISTAKES,
    OUTCOMES,
    gripper_goal,
    joint_goal,
    obstacle_cubes,
    outcome_of,
    pose_goal,
)

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import make_transform

MESSAGES = FakeMessages()
R = Rotation.from_euler("xyz", [3.0, 0.2, 0.7])
T = make_transform(R.as_matrix(), np.array([0.5, -0.1, 0.2]))


def test_a_pose_goal_names_rrt_star_and_fits_its_definition():
    goal = pose_goal(MESSAGES, parameters(), T)
    assert len(goal.bytes()) > 100
    request = goal.request
    assert (request.planner_id, request.pipeline_id, request.group_name) == ("RRTstar", "ompl", "manipulator")
    assert (request.max_velocity_scaling_factor, request.max_acceleration_scaling_factor) == (0.1, 0.1)
    assert request.start_state.is_diff
    assert not goal.planning_options.plan_only
    assert goal.planning_options.planning_scene_diff.is_diff
    (constraints,) = request.goal_constraints
    (position,), (orientation,) = constraints.position_constraints, constraints.orientation_constraints
    assert {position.header.frame_id, orientation.header.frame_id} == {"base_link"}
    assert {position.link_name, orientation.link_name} == {"tool0"}
    at = position.constraint_region.primitive_poses[0].position
    assert np.allclose([at.x, at.y, at.z], T[:3, 3])
    assert position.constraint_region.primitives[0].dimensions == [0.002]
    q = orientation.orientation
    assert np.allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), R.as_matrix())
    assert position.weight == orientation.weight == 1.0


def test_the_offset_of_the_tcp_is_taken_off():
    told = parameters(tcp_offset=(0.0, 0.0, 0.163, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    (constraints,) = pose_goal(MESSAGES, told, T).request.goal_constraints
    at = constraints.position_constraints[0].constraint_region.primitive_poses[0].position
    assert np.allclose([at.x, at.y, at.z], T[:3, 3] - 0.163 * T[:3, 2])
    q = constraints.orientation_constraints[0].orientation
    link = Rotation.from_quat([q.x, q.y, q.z, q.w])
    assert np.allclose((link * Rotation.from_euler("z", 90, degrees=True)).as_matrix(), R.as_matrix())


def test_straight_moves_have_their_own_planner():
    request = pose_goal(MESSAGES, parameters(), T, straight=True).request
    assert (request.planner_id, request.pipeline_id) == ("LIN", "pilz_industrial_motion_planner")


def test_a_joint_goal():
    (constraints,) = joint_goal(MESSAGES, parameters(), [0.1 * i for i in range(6)]).request.goal_constraints
    assert [j.joint_name for j in constraints.joint_constraints] == list(JOINTS)
    assert [j.position for j in constraints.joint_constraints] == pytest.approx([0.1 * i for i in range(6)])
    assert {j.tolerance_above for j in constraints.joint_constraints} == {0.01}


@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), np.eye(3), np.where(np.eye(4, k=3) > 0, np.inf, np.eye(4))])
def test_a_pose_that_is_none_is_refused(bad):
    with pytest.raises(InputError, match=r"must be a finite \(4, 4\) pose"):
        pose_goal(MESSAGES, parameters(), bad)


def test_the_perceived_cloud_becomes_cubes():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-0.2, 0.2, (800, 3)) + np.array([0.5, 0, 0.2])
    told = parameters(obstacle_m=0.03, clear_m=0.08)
    middle = np.array([0.5, 0.0, 0.2])
    cubes = obstacle_cubes(cloud, told, [middle])
    assert cubes is not None
    assert len(np.unique(np.rint(cubes * 1e4), axis=0)) == len(cubes)
    away = np.linalg.norm(cloud - middle, axis=1) > 0.08
    inside = np.abs(cloud[away][:, None] - cubes[None]).max(axis=2).min(axis=1)
    assert inside.max() <= 0.015 + 1e-6, "every point that counts is in a cube"
    assert (np.linalg.norm(cubes - middle, axis=1) > 0.08 - 0.027).all()
    goal = pose_goal(MESSAGES, told, T, obstacles=cubes)
    (thing,) = goal.planning_options.planning_scene_diff.world.collision_objects
    assert len(thing.primitives) == len(thing.primitive_poses) == len(cubes)
    assert thing.operation == b"\0"
    assert len(goal.bytes()) > 1000


def test_of_too_many_cubes_the_nearest_stay_and_none_are_wanted_at_zero():
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 3))
    cubes = obstacle_cubes(cloud, parameters(max_obstacles=100), [np.zeros(3)])
    assert cubes is not None
    assert len(cubes) == 100
    assert np.linalg.norm(cubes, axis=1).max() < 0.3
    assert obstacle_cubes(cloud, parameters(obstacle_m=0.0), [np.zeros(3)]) is None
    assert not pose_goal(MESSAGES, parameters(), T).planning_options.planning_scene_diff.world.collision_objects
    nothing = obstacle_cubes(np.zeros((0, 3)), parameters(), [np.zeros(3)])
    assert nothing is not None
    assert len(nothing) == 0


@pytest.mark.parametrize(("width", "position"), [(0.085, 0.0), (0.0, 0.8), (0.0425, 0.4), (0.2, 0.0), (-1.0, 0.8)])
def test_gripper_goals(width, position):
    goal = gripper_goal(MESSAGES, parameters(), width)
    assert goal.command.position == pytest.approx(position)
    assert goal.command.max_effort == 40.0
    assert goal.bytes()


def test_every_code_of_moveit_means_something():
    """The codes of moveit_msgs/msg/MoveItErrorCodes."""
    codes = {1, 0, 99999, *range(-7, 0), *range(-19, -9), *range(-31, -20)} - {-8, -9, -20}
    assert {1, *OUTCOMES, *MISTAKES, *FAULTS} == codes
    assert outcome_of(1) is None
    assert {outcome_of(code) for code in OUTCOMES} == {"unreachable", "collision", "preempted"}
    for code, (name, parameter) in MISTAKES.items():
        with pytest.raises(ConfigError, match=f"{name} .*check the parameter {parameter}"):
            outcome_of(code)
    for code in (*FAULTS, -1234):
        with pytest.raises(RobotFault, match=rf"\({code}\); look at the robot"):
            outcome_of(code)
