"""ROS without ROS: messages that know their definition, and a clock, frames, MoveIt and a gripper that follow a script.

Standard messages come from the definitions of ROS 2 Jazzy in `rosbags`, ours from the files of `thinkgrasp_interfaces`;
of MoveIt's and the gripper's, which rosbags does not have, the fields that a goal may set are listed here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ros2" / "thinkgrasp_ros"
INTERFACES = ROOT / "ros2" / "thinkgrasp_interfaces"
if str(PACKAGE) not in sys.path:
    sys.path.insert(0, str(PACKAGE))

typesys = pytest.importorskip("rosbags.typesys", reason="needs rosbags, of the dependency group test")

from rosbags.interfaces import Nodetype  # noqa: E402
from thinkgrasp_ros.interface import GripperState, TransformUnavailable  # noqa: E402
from thinkgrasp_ros.parameters import CameraParameters, Parameters  # noqa: E402

MOVEIT = {
    "action/MoveGroup_Goal": "MotionPlanRequest request\nPlanningOptions planning_options",
    "msg/MotionPlanRequest": """WorkspaceParameters workspace_parameters
        RobotState start_state
        Constraints[] goal_constraints
        Constraints path_constraints
        string pipeline_id
        string planner_id
        string group_name
        int32 num_planning_attempts
        float64 allowed_planning_time
        float64 max_velocity_scaling_factor
        float64 max_acceleration_scaling_factor
        string cartesian_speed_limited_link
        float64 max_cartesian_speed""",
    "msg/WorkspaceParameters": "std_msgs/Header header",
    "msg/RobotState": """sensor_msgs/JointState joint_state
        AttachedCollisionObject[] attached_collision_objects
        bool is_diff""",
    "msg/AttachedCollisionObject": """string link_name
        CollisionObject object
        string[] touch_links
        trajectory_msgs/JointTrajectory detach_posture
        float64 weight""",
    "msg/Constraints": """string name
        JointConstraint[] joint_constraints
        PositionConstraint[] position_constraints
        OrientationConstraint[] orientation_constraints""",
    "msg/JointConstraint": """string joint_name
        float64 position
        float64 tolerance_above
        float64 tolerance_below
        float64 weight""",
    "msg/PositionConstraint": """std_msgs/Header header
        string link_name
        geometry_msgs/Vector3 target_point_offset
        BoundingVolume constraint_region
        float64 weight""",
    "msg/OrientationConstraint": """std_msgs/Header header
        geometry_msgs/Quaternion orientation
        string link_name
        float64 absolute_x_axis_tolerance
        float64 absolute_y_axis_tolerance
        float64 absolute_z_axis_tolerance
        uint8 parameterization
        float64 weight""",
    "msg/BoundingVolume": "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses",
    "msg/PlanningOptions": """PlanningScene planning_scene_diff
        bool plan_only
        bool look_around
        int32 look_around_attempts
        bool replan
        int32 replan_attempts
        float64 replan_delay""",
    "msg/PlanningScene": "string name\nRobotState robot_state\nPlanningSceneWorld world\nbool is_diff",
    "msg/PlanningSceneWorld": "CollisionObject[] collision_objects",
    "msg/CollisionObject": """std_msgs/Header header
        geometry_msgs/Pose pose
        string id
        shape_msgs/SolidPrimitive[] primitives
        geometry_msgs/Pose[] primitive_poses
        byte operation""",
}
CONTROL = {
    "action/GripperCommand_Goal": "GripperCommand command",
    "msg/GripperCommand": "float64 position\nfloat64 max_effort",
}


@cache
def store() -> Any:
    """All definitions, parsed."""
    found = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    for package, messages in (("moveit_msgs", MOVEIT), ("control_msgs", CONTROL)):
        for name, text in messages.items():
            lines = "\n".join(line.strip() for line in text.splitlines())
            found.register(
                _renamed(
                    typesys.get_types_from_msg(lines, f"{package}/msg/{name.rpartition('/')[2]}"), f"{package}/{name}"
                )
            )
    for name, text in interface_parts().items():
        found.register(_renamed(typesys.get_types_from_msg(text, name.replace("/srv/", "/msg/")), name))
    return found


def interface_parts() -> dict[str, str]:
    """Our interface files, part by part, by the name that a message of it has in ROS."""
    parts = {f"thinkgrasp_interfaces/msg/{p.stem}": p.read_text() for p in sorted(INTERFACES.glob("msg/*.msg"))}
    suffixes = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
    for kind, names in suffixes.items():
        for path in sorted(INTERFACES.glob(f"{kind}/*.{kind}")):
            texts: list[str] = [""]
            for line in path.read_text().splitlines():
                texts += [""] if line.strip() == "---" else []
                texts[-1] += "" if line.strip() == "---" else f"{line}\n"
            for suffix, text in zip(names, texts, strict=True):
                parts[f"thinkgrasp_interfaces/{kind}/{path.stem}_{suffix}"] = text
    return parts


def _renamed(types: dict[str, Any], name: str) -> dict[str, Any]:
    (definition,) = types.values()
    return {name: definition}


_RANGES = {
    **{f"{sign}int{bits}": bits for sign in ("", "u") for bits in (8, 16, 32, 64)},
}


class Strict:
    """A message as rclpy would make it: default values, no other fields, no values of another type."""

    def __init__(self, name: str) -> None:
        consts, fields = store().fielddefs[name]
        object.__setattr__(self, "_name", name)
        object.__setattr__(self, "_fields", dict(fields))
        for key, node in fields:
            object.__setattr__(self, key, _default(node))
        for key, _, value in consts:
            object.__setattr__(self, key, value)

    def __setattr__(self, key: str, value: Any) -> None:
        if key not in self._fields:
            raise AttributeError(f"{self._name} has no field {key!r}; it has {', '.join(self._fields)}")
        _check(f"{self._name}.{key}", self._fields[key], value)
        object.__setattr__(self, key, value)

    def native(self) -> Any:
        """The same as a message of rosbags, which it can turn into bytes."""
        kind = store().types[self._name]
        return kind(**{key: _native(node, getattr(self, key)) for key, node in self._fields.items()})

    def bytes(self) -> bytes:
        """The message as it goes over the wire; fails where a value does not fit its field."""
        return bytes(store().serialize_cdr(self.native(), self._name))


def _default(node: Any) -> Any:
    kind, about = node
    if kind == Nodetype.NAME:
        return Strict(about)
    if kind == Nodetype.BASE:
        base = about[0]
        defaults: dict[str, Any] = {"string": "", "bool": False, "byte": b"\0"}
        return defaults.get(base, 0.0 if base.startswith("float") else 0)
    if kind == Nodetype.ARRAY:
        return [_default(about[0]) for _ in range(about[1])]
    return []


def _check(where: str, node: Any, value: Any) -> None:
    kind, about = node
    if kind == Nodetype.NAME:
        assert isinstance(value, Strict), f"{where} must be a {about}, got {value!r}"
        assert value._name == about, f"{where} must be a {about}, got a {value._name}"
    elif kind == Nodetype.BASE:
        _check_base(where, about[0], value)
    else:
        inner, count = about
        assert not isinstance(value, str), f"{where} must be a list"
        assert kind != Nodetype.ARRAY or len(value) == count, f"{where} must have {count} values, got {len(value)}"
        assert kind != Nodetype.SEQUENCE or not count or len(value) <= count, f"{where}: at most {count} values"
        if not isinstance(value, bytes | bytearray | np.ndarray):
            for item in value:
                _check(where, inner, item)


def _check_base(where: str, base: str, value: Any) -> None:
    kinds = {"string": str, "bool": bool, "byte": bytes}
    wanted = kinds.get(base, float if base.startswith("float") else int)
    assert type(value) is wanted, f"{where} must be a {wanted.__name__} ({base}), got {value!r}"
    assert base != "byte" or len(value) == 1, f"{where} must be one byte, got {value!r}"
    if base in _RANGES:
        bits = _RANGES[base]
        low, high = (0, 2**bits) if base.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        assert low <= value < high, f"{where}: {value} does not fit {base}"


def _native(node: Any, value: Any) -> Any:
    kind, about = node
    if kind == Nodetype.NAME:
        return value.native()
    if kind == Nodetype.BASE:
        return value[0] if about[0] == "byte" else value
    inner = about[0]
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        base = inner[1][0]
        return np.array(value if not isinstance(value, bytes) else np.frombuffer(value, np.uint8), np.dtype(base))
    return [_native(inner, item) for item in value]


class FakeMessages:
    """Makes strict messages and keeps them."""

    def new(self, name: str) -> Strict:
        return Strict(name)


@dataclass
class FakeClock:
    ns: int = 1_000_000_000_000

    def now_ns(self) -> int:
        return self.ns


class FakeTransforms:
    """One pose for every camera frame that is known; knows it up to a time."""

    def __init__(self, poses: dict[str, np.ndarray], until_ns: int = 2**62) -> None:
        self.poses, self.until_ns, self.asked = poses, until_ns, list[tuple[str, str, int]]()

    def lookup(self, target: str, source: str, stamp_ns: int) -> np.ndarray:
        self.asked.append((target, source, stamp_ns))
        if source not in self.poses:
            raise TransformUnavailable(f'"{source}" passed to lookupTransform argument source_frame does not exist')
        if stamp_ns > self.until_ns:
            raise TransformUnavailable("Lookup would require extrapolation into the future")
        return self.poses[source]


@dataclass
class FakeMotions:
    """MoveIt that answers by a script of codes, then 1; calls back before each motion."""

    script: list[int] = field(default_factory=list)
    goals: list[Strict] = field(default_factory=list)
    before: Callable[[int], None] = lambda n: None

    def move(self, goal: Strict, cancelled: Callable[[], bool]) -> int:
        self.before(len(self.goals))
        self.goals.append(goal)
        goal.bytes()
        if cancelled():
            return -7
        return self.script.pop(0) if self.script else 1


@dataclass
class FakeScene:
    """MoveIt's planning scene: what hangs on links, and what stands in the world, by name."""

    attached: dict[str, Strict] = field(default_factory=dict)
    world: set[str] = field(default_factory=set)
    answers: bool = True
    asked: int = 0

    def apply(self, scene: Strict) -> bool:
        scene.bytes()
        assert scene.is_diff, "all that MoveIt knows would be forgotten"
        assert scene.robot_state.is_diff
        self.asked += 1
        good = self.answers
        for one in scene.robot_state.attached_collision_objects if good else ():
            if one.object.operation == b"\0":
                assert one.link_name
                assert len(one.object.primitives) == len(one.object.primitive_poses) == 1
                self.attached[one.object.id] = one
            elif self.attached.pop(one.object.id, None) is not None:
                self.world.add(one.object.id)
        for thing in scene.world.collision_objects if good else ():
            assert thing.operation == b"\1"
            good &= thing.id in self.world
            self.world.discard(thing.id)
        return good


@dataclass
class FakeGripper:
    """A gripper that stalls on something this wide, given by attempt; 0 = there is nothing."""

    parameters: Parameters
    widths_m: list[float] = field(default_factory=lambda: [0.03])
    goals: list[Strict] = field(default_factory=list)

    def command(self, goal: Strict, cancelled: Callable[[], bool]) -> GripperState:
        self.goals.append(goal)
        goal.bytes()
        wanted = goal.command.position
        if wanted < self.parameters.gripper_closed - 1e-9:
            return GripperState(wanted, False, True)
        width = self.widths_m.pop(0) if len(self.widths_m) > 1 else self.widths_m[0]
        met = self.parameters.gripper_position(width)
        return GripperState(met, width > 0, width == 0)


JOINTS = ("a", "b", "c", "d", "e", "f")


def parameters(**changes: Any) -> Parameters:
    """Parameters of a robot with six joints and one or more cameras."""
    cameras: Sequence[str] = changes.get("cameras", ("camera",))
    values: dict[str, Any] = {
        "joint_names": JOINTS,
        "home_joints": (0.0,) * 6,
        "place_joints": (1.0,) * 6,
        "image_timeout_s": 0.3,
        "obstacle_m": 0.08,
        "camera_parameters": tuple(CameraParameters.read(name, lambda key, default: default) for name in cameras),
    }
    return Parameters(**(values | changes))


def stamped(message: Strict, ns: int, frame: str = "camera_optical") -> Strict:
    """The message with a header."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 10**9)
    message.header.frame_id = frame
    return message


def image(
    array: np.ndarray, encoding: str, ns: int, *, pad: int = 0, big: bool = False, frame: str = "camera_optical"
) -> Strict:
    """An Image message of (H, W) or (H, W, C), with so many bytes of padding a row."""
    message = stamped(Strict("sensor_msgs/msg/Image"), ns, frame)
    message.height, message.width = int(array.shape[0]), int(array.shape[1])
    message.encoding, message.is_bigendian = encoding, int(big)
    ordered = array.astype(array.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(ordered.tobytes(), np.uint8).reshape(array.shape[0], -1)
    padded = np.pad(rows, ((0, 0), (0, pad)), constant_values=171)
    message.step = int(padded.shape[1])
    message.data = padded.tobytes()
    return message


def camera_info(camera: Any, ns: int, *, d: Sequence[float] = (), frame: str = "camera_optical") -> Strict:
    """A CameraInfo message of a pinhole camera."""
    message = stamped(Strict("sensor_msgs/msg/CameraInfo"), ns, frame)
    message.width, message.height = camera.width, camera.height
    message.distortion_model, message.d = "plumb_bob", [float(v) for v in d]
    message.k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message
