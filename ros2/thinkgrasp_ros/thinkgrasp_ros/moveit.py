"""Goals of MoveIt's move_group action, and what its error codes mean for the loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import invert, make_transform, quat_wxyz
from thinkgrasp_ros.held import HeldBox
from thinkgrasp_ros.interface import Message, Messages, RobotFault, Transform
from thinkgrasp_ros.parameters import Parameters

_HELD = "thinkgrasp_held"
_REMOVE = bytes([1])
"""CollisionObject.REMOVE; a byte of ROS is bytes of length one in Python."""
SUCCESS = 1
TIMED_OUT = -6
CONTROL_FAILED = -4

OUTCOMES = {
    -1: "unreachable",  # PLANNING_FAILED
    -2: "unreachable",  # INVALID_MOTION_PLAN
    -6: "unreachable",  # TIMED_OUT
    -12: "unreachable",  # GOAL_IN_COLLISION
    -13: "unreachable",  # GOAL_VIOLATES_PATH_CONSTRAINTS
    -14: "unreachable",  # GOAL_CONSTRAINTS_VIOLATED
    -27: "unreachable",  # GOAL_STATE_INVALID
    -31: "unreachable",  # NO_IK_SOLUTION
    99999: "unreachable",  # FAILURE, which planning pipelines answer where they find nothing
    -3: "collision",  # MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
    -7: "preempted",  # PREEMPTED
}
"""What an attempt can expect; the loop goes on with another grasp, but for "preempted", see `MoveItRobot`."""

MISTAKES = {
    0: ("UNDEFINED", "pipeline or straight_pipeline"),  # left so where move_group knows no such pipeline
    -15: ("INVALID_GROUP_NAME", "group"),
    -16: ("INVALID_GOAL_CONSTRAINTS", "tcp_link, planner or straight_planner"),
    -17: ("INVALID_ROBOT_STATE", "joint_names"),
    -18: ("INVALID_LINK_NAME", "tcp_link"),
    -21: ("FRAME_TRANSFORM_FAILURE", "world_frame"),
    -28: ("UNRECOGNIZED_GOAL_TYPE", "straight_planner"),
}
"""Codes that say that a parameter does not fit the robot, and which."""

FAULTS = {
    -4: "CONTROL_FAILED",
    -5: "UNABLE_TO_AQUIRE_SENSOR_DATA",
    -10: "START_STATE_IN_COLLISION",
    -11: "START_STATE_VIOLATES_PATH_CONSTRAINTS",
    -19: "INVALID_OBJECT_NAME",
    -22: "COLLISION_CHECKING_UNAVAILABLE",
    -23: "ROBOT_STATE_STALE",
    -24: "SENSOR_INFO_STALE",
    -25: "COMMUNICATION_FAILURE",
    -26: "START_STATE_INVALID",
    -29: "CRASH",
    -30: "ABORT",
}
"""Codes after which nothing may be tried on before a person has looked."""


def outcome_of(code: int) -> str | None:
    """Return the named reason of a motion that did not succeed; None where it did.

    Raises:
        ConfigError: A parameter does not fit the robot.
        RobotFault: The robot, its driver or MoveIt failed.
    """
    if code == SUCCESS:
        return None
    if code in OUTCOMES:
        return OUTCOMES[code]
    if code in MISTAKES:
        name, parameter = MISTAKES[code]
        raise ConfigError(f"MoveIt answers {name} ({code}): check the parameter {parameter}")
    raise RobotFault(
        f"MoveIt answers {FAULTS.get(code, 'an unknown error')} ({code}); look at the robot and move_group's log"
    )


def pose_goal(
    messages: Messages,
    parameters: Parameters,
    T_world_tcp: Transform,
    *,
    straight: bool = False,
    obstacles: NDArray[np.floating] | None = None,
) -> Message:
    """Return a MoveGroup goal that brings the TCP to a pose.

    Args:
        messages: Makes messages.
        parameters: Group, link, planners, tolerances, speeds.
        T_world_tcp: (4, 4) in the world frame.
        straight: By the planner for straight lines; else by RRT*, or whatever the parameter planner names.
        obstacles: Cubes' middles (N, 3) [m], world, to be kept clear of.

    Raises:
        InputError: The pose is not finite.
    """
    if T_world_tcp.shape != (4, 4) or not np.isfinite(T_world_tcp).all():
        raise InputError(f"a goal for the TCP must be a finite (4, 4) pose, got {T_world_tcp.tolist()}")
    T_world_link = T_world_tcp @ invert(parameters.T_link_tcp)
    goal = _goal(messages, parameters, straight=straight, obstacles=obstacles)
    x, y, z = (float(v) for v in T_world_link[:3, 3])
    qw, qx, qy, qz = (float(v) for v in quat_wxyz(T_world_link[:3, :3]))

    position = messages.new("moveit_msgs/msg/PositionConstraint")
    position.header.frame_id = parameters.world_frame
    position.link_name = parameters.tcp_link
    ball = messages.new("shape_msgs/msg/SolidPrimitive")
    ball.type = 2  # SPHERE
    ball.dimensions = [parameters.position_tolerance_m]
    centre = messages.new("geometry_msgs/msg/Pose")
    centre.position.x, centre.position.y, centre.position.z = x, y, z
    centre.orientation.w = 1.0
    position.constraint_region.primitives = [ball]
    position.constraint_region.primitive_poses = [centre]
    position.weight = 1.0

    orientation = messages.new("moveit_msgs/msg/OrientationConstraint")
    orientation.header.frame_id = parameters.world_frame
    orientation.link_name = parameters.tcp_link
    q = orientation.orientation
    q.x, q.y, q.z, q.w = qx, qy, qz, qw
    for axis in "xyz":
        setattr(orientation, f"absolute_{axis}_axis_tolerance", parameters.angle_tolerance_rad)
    orientation.weight = 1.0

    constraints = messages.new("moveit_msgs/msg/Constraints")
    constraints.position_constraints = [position]
    constraints.orientation_constraints = [orientation]
    goal.request.goal_constraints = [constraints]
    return goal


def joint_goal(
    messages: Messages,
    parameters: Parameters,
    joints_rad: Sequence[float],
    *,
    obstacles: NDArray[np.floating] | None = None,
) -> Message:
    """Return a MoveGroup goal that brings the joints named in the parameters to angles."""
    goal = _goal(messages, parameters, straight=False, obstacles=obstacles)
    joints: list[Message] = []
    for name, angle in zip(parameters.joint_names, joints_rad, strict=True):
        joint = messages.new("moveit_msgs/msg/JointConstraint")
        joint.joint_name = name
        joint.position = float(angle)
        joint.tolerance_above = joint.tolerance_below = parameters.angle_tolerance_rad
        joint.weight = 1.0
        joints.append(joint)
    constraints = messages.new("moveit_msgs/msg/Constraints")
    constraints.joint_constraints = joints
    goal.request.goal_constraints = [constraints]
    return goal


def gripper_goal(messages: Messages, parameters: Parameters, width_m: float) -> Message:
    """Return a GripperCommand goal for an opening [m]."""
    goal = messages.new("control_msgs/action/GripperCommand_Goal")
    goal.command.position = float(parameters.gripper_position(width_m))
    goal.command.max_effort = float(parameters.gripper_effort)
    return goal


def scene_holding(messages: Messages, parameters: Parameters, box: HeldBox) -> Message:
    """Return a PlanningScene difference that hangs a box to the link that goals are for."""
    T_link_box = parameters.T_link_tcp @ make_transform(np.eye(3), box.middle)
    attached = _held(messages, parameters)
    thing = attached.object
    thing.header.frame_id = parameters.tcp_link
    place, turn = thing.pose.position, thing.pose.orientation
    place.x, place.y, place.z = (float(v) for v in T_link_box[:3, 3])
    turn.w, turn.x, turn.y, turn.z = (float(v) for v in quat_wxyz(T_link_box[:3, :3]))
    block = messages.new("shape_msgs/msg/SolidPrimitive")
    block.type = 1  # BOX
    block.dimensions = [float(side) for side in box.sides]
    middle = messages.new("geometry_msgs/msg/Pose")
    middle.orientation.w = 1.0
    thing.primitives, thing.primitive_poses = [block], [middle]
    attached.touch_links = [parameters.tcp_link, *parameters.touch_links]
    scene = _scene_difference(messages)
    scene.robot_state.attached_collision_objects = [attached]
    return scene


def scene_empty_handed(messages: Messages, parameters: Parameters) -> Message:
    """Return a PlanningScene difference that takes what `scene_holding` hung there off, and out of the world.

    MoveIt puts what is taken off where it was left, as an obstacle; in one message it does so before it looks at the
    world's objects.
    """
    attached = _held(messages, parameters)
    attached.object.operation = _REMOVE
    left = messages.new("moveit_msgs/msg/CollisionObject")
    left.id, left.operation = _HELD, _REMOVE
    scene = _scene_difference(messages)
    scene.robot_state.attached_collision_objects = [attached]
    scene.world.collision_objects = [left]
    return scene


def _held(messages: Messages, parameters: Parameters) -> Message:
    attached = messages.new("moveit_msgs/msg/AttachedCollisionObject")
    attached.link_name = parameters.tcp_link
    attached.object.id = _HELD
    return attached


def _scene_difference(messages: Messages) -> Message:
    scene = messages.new("moveit_msgs/msg/PlanningScene")
    scene.is_diff = scene.robot_state.is_diff = True
    return scene


def obstacle_cubes(
    cloud: NDArray[np.floating], parameters: Parameters, keep_clear: Sequence[NDArray[np.floating]]
) -> NDArray[np.float64] | None:
    """Return the middles (N, 3) of the cubes that a perceived cloud fills, in the cloud's frame; None = not wanted.

    Args:
        cloud: (M, 3) [m], world.
        parameters: Side of the cubes, how many at most (those nearest to the first clear point stay), the room kept.
        keep_clear: Points (3,) around which nothing is put.
    """
    if parameters.obstacle_m == 0:
        return None
    side = parameters.obstacle_m
    points = np.asarray(cloud, np.float64)
    for centre in keep_clear:
        points = points[np.linalg.norm(points - centre, axis=1) > parameters.clear_m]
    cubes = (np.unique(np.floor(points / side), axis=0) + 0.5) * side
    if len(cubes) > parameters.max_obstacles:
        distance = np.linalg.norm(cubes - keep_clear[0], axis=1) if len(keep_clear) else np.zeros(len(cubes))
        cubes = cubes[np.sort(np.argsort(distance, kind="stable")[: parameters.max_obstacles])]
    return cubes


def _goal(
    messages: Messages, parameters: Parameters, *, straight: bool, obstacles: NDArray[np.floating] | None
) -> Message:
    goal = messages.new("moveit_msgs/action/MoveGroup_Goal")
    request = goal.request
    request.group_name = parameters.group
    request.pipeline_id = parameters.straight_pipeline if straight else parameters.pipeline
    request.planner_id = parameters.straight_planner if straight else parameters.planner
    request.num_planning_attempts = int(parameters.planning_attempts)
    request.allowed_planning_time = float(parameters.planning_time_s)
    request.max_velocity_scaling_factor = float(parameters.velocity_scale)
    request.max_acceleration_scaling_factor = float(parameters.acceleration_scale)
    request.start_state.is_diff = True
    request.workspace_parameters.header.frame_id = parameters.world_frame
    options = goal.planning_options
    options.plan_only = False
    options.replan = False
    options.planning_scene_diff.is_diff = True
    options.planning_scene_diff.robot_state.is_diff = True
    if obstacles is not None and len(obstacles):
        options.planning_scene_diff.world.collision_objects = [_cubes(messages, parameters, obstacles)]
    return goal


def _cubes(messages: Messages, parameters: Parameters, middles: NDArray[np.floating]) -> Message:
    """One collision object of many cubes; added for this goal alone."""
    thing = messages.new("moveit_msgs/msg/CollisionObject")
    thing.header.frame_id = parameters.world_frame
    thing.id = "thinkgrasp_perceived"
    thing.pose.orientation.w = 1.0
    cubes: list[Message] = []
    poses: list[Message] = []
    for middle in middles:
        cube = messages.new("shape_msgs/msg/SolidPrimitive")
        cube.type = 1  # BOX
        cube.dimensions = [float(parameters.obstacle_m)] * 3
        pose = messages.new("geometry_msgs/msg/Pose")
        pose.position.x, pose.position.y, pose.position.z = (float(v) for v in middle)
        pose.orientation.w = 1.0
        cubes.append(cube)
        poses.append(pose)
    thing.primitives = cubes
    thing.primitive_poses = poses
    return thing
