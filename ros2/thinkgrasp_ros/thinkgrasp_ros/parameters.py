"""The node's parameters: names, defaults, limits. A table of them is in docs/ros2.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Self, SupportsFloat

import numpy as np

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import make_transform, rotation_from_quat_wxyz
from thinkgrasp_ros.interface import Transform

Lookup = Callable[[str, Any], Any]
"""Declares a parameter with its default and returns its value."""
_NAMES = ("cameras", "settings", "joint_names", "touch_links")
"""Lists of text; all others hold numbers."""


@dataclass(frozen=True)
class CameraParameters:
    """One camera: where its images are."""

    name: str
    color_topic: str
    depth_topic: str
    info_topic: str
    rectified: bool = False
    """The images are rectified: P of camera_info counts, D does not."""

    @classmethod
    def read(cls, name: str, lookup: Lookup) -> Self:
        """Read `<name>.color_topic` and so on; by default the topics of realsense2_camera with aligned depth."""
        defaults = {
            "color_topic": f"/{name}/color/image_raw",
            "depth_topic": f"/{name}/aligned_depth_to_color/image_raw",
            "info_topic": f"/{name}/color/camera_info",
            "rectified": False,
        }
        found = {f"{name}.{key}": (lookup(f"{name}.{key}", default), default) for key, default in defaults.items()}
        return cls(name, *(_typed(key, value, default) for key, (value, default) in found.items()))


@dataclass(frozen=True)
class Parameters:
    """Everything that the node is told.

    Raises:
        ConfigError: A value is of another type, or out of range.
    """

    cameras: Sequence[str] = ("camera",)
    """Names; the first camera is looked through, the others where it shows no grasp."""
    world_frame: str = "base_link"
    """Of poses and of the robot's goals; z up."""
    preset: str = "offline"
    settings: Sequence[str] = ()
    """Of the stages, as KEY=VALUE."""
    gripper: str = "robotiq_2f85"
    fusion: str = "last"
    step_limit: int = 15
    workspace: Sequence[float] = ()
    """Lowest and highest corner (x, y, z, x, y, z) of where grasping is allowed, world [m]; empty = everywhere."""

    sync_slop_s: float = 0.05
    """Colour, depth and camera_info may be so far apart."""
    image_timeout_s: float = 5.0
    tf_timeout_s: float = 0.5

    move_group_action: str = "/move_action"
    scene_service: str = "/apply_planning_scene"
    group: str = "manipulator"
    tcp_link: str = "tool0"
    tcp_offset: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Pose of the TCP (between the fingertips, z approach, x closing) in `tcp_link`: x y z, quaternion x y z w."""
    touch_links: Sequence[str] = ()
    """Of the gripper, which what is held touches; empty = MoveIt is not told what is held."""
    planner: str = "RRTstar"
    pipeline: str = "ompl"
    straight_planner: str = "LIN"
    straight_pipeline: str = "pilz_industrial_motion_planner"
    planning_time_s: float = 5.0
    planning_attempts: int = 1
    velocity_scale: float = 0.1
    acceleration_scale: float = 0.1
    position_tolerance_m: float = 0.002
    angle_tolerance_rad: float = 0.01
    standoff_m: float = 0.10
    lift_m: float = 0.15
    obstacle_m: float = 0.02
    """Side of the cubes that the perceived cloud is given to MoveIt as; 0 = it is not."""
    clear_m: float = 0.10
    """Points this near to the TCP are left out of them: what is taken, and what the collision check has looked at."""
    max_obstacles: int = 3000
    joint_names: Sequence[str] = ()
    place_joints: Sequence[float] = ()
    """Where what is held is let go, [rad], in the order of `joint_names`."""
    home_joints: Sequence[float] = ()
    """Where the robot waits and does not hide the table from the cameras."""
    motion_timeout_s: float = 60.0

    gripper_action: str = "/gripper_controller/gripper_cmd"
    gripper_open: float = 0.0
    gripper_closed: float = 0.8
    """The controller's positions where the gripper is open by `stroke_m`, and closed."""
    stroke_m: float = 0.085
    gripper_effort: float = 40.0
    held_margin: float = 0.03
    """Share of the way from open to closed: a gripper that stops this near to closed holds nothing."""
    gripper_timeout_s: float = 10.0

    camera_parameters: tuple[CameraParameters, ...] = field(default=(), metadata={"declared": False})

    def __post_init__(self) -> None:
        positive = ("sync_slop_s", "image_timeout_s", "planning_time_s", "position_tolerance_m", "angle_tolerance_rad")
        positive += ("standoff_m", "lift_m", "stroke_m", "motion_timeout_s", "gripper_timeout_s", "gripper_effort")
        for name in positive:
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"parameter {name} must be positive, got {getattr(self, name)}")
        for name in ("velocity_scale", "acceleration_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"parameter {name} must lie in (0, 1], got {getattr(self, name)}")
        for name, least in (("tf_timeout_s", 0), ("obstacle_m", 0), ("clear_m", 0), ("held_margin", 0)):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= least):
                raise ConfigError(f"parameter {name} must be at least {least}, got {getattr(self, name)}")
        for name in ("step_limit", "planning_attempts", "max_obstacles"):
            if getattr(self, name) < 1:
                raise ConfigError(f"parameter {name} must be at least 1, got {getattr(self, name)}")
        for name in (
            "world_frame",
            "group",
            "tcp_link",
            "planner",
            "move_group_action",
            "scene_service",
            "gripper_action",
        ):
            if not getattr(self, name):
                raise ConfigError(f"parameter {name} must not be empty")
        if not self.cameras or len(set(self.cameras)) != len(self.cameras):
            raise ConfigError(f"parameter cameras must name each camera once, got {list(self.cameras)}")
        for name in ("gripper_open", "gripper_closed"):
            if not math.isfinite(getattr(self, name)):
                raise ConfigError(f"parameter {name} must be finite, got {getattr(self, name)}")
        if self.held_margin >= 1:
            raise ConfigError(f"parameter held_margin must be less than 1, got {self.held_margin}")
        if self.gripper_open == self.gripper_closed:
            raise ConfigError(f"parameters gripper_open and gripper_closed are both {self.gripper_open}")
        self._check_arrays()

    def _check_arrays(self) -> None:
        for name, sizes in (("workspace", (0, 6)), ("tcp_offset", (7,))):
            values = getattr(self, name)
            if len(values) not in sizes or not np.isfinite(np.array(values, np.float64)).all():
                raise ConfigError(f"parameter {name} must be {sizes[-1]} finite numbers, got {list(values)}")
        if len(self.workspace) and not (np.array(self.workspace[:3]) < np.array(self.workspace[3:])).all():
            raise ConfigError(
                f"parameter workspace must be its lowest corner, then its highest: {list(self.workspace)}"
            )
        if abs(np.linalg.norm(self.tcp_offset[3:]) - 1) > 1e-3:
            raise ConfigError(
                f"parameter tcp_offset must end in a unit quaternion x y z w, got {list(self.tcp_offset)}"
            )
        for name in ("place_joints", "home_joints"):
            values = getattr(self, name)
            if len(values) != len(self.joint_names) or not np.isfinite(np.array(values, np.float64)).all():
                raise ConfigError(
                    f"parameter {name} must be {len(self.joint_names)} finite angles, one for each of joint_names, got "
                    f"{list(values)}"
                )

    @property
    def T_link_tcp(self) -> Transform:  # noqa: N802
        """(4, 4) pose of the TCP in `tcp_link`."""
        x, y, z, w = self.tcp_offset[3:]
        return make_transform(rotation_from_quat_wxyz(np.array([w, x, y, z])), np.array(self.tcp_offset[:3]))

    def gripper_position(self, width_m: float) -> float:
        """Return the controller's position at an opening; linear between open and closed, cut off beyond."""
        share = 1 - min(max(width_m / self.stroke_m, 0.0), 1.0)
        return self.gripper_open + share * (self.gripper_closed - self.gripper_open)

    def opening_m(self, position: float) -> float:
        """Return the opening [m] at a controller's position: what `gripper_position` is of."""
        return self.stroke_m * (self.gripper_closed - position) / (self.gripper_closed - self.gripper_open)

    def is_closed(self, position: float) -> bool:
        """Whether a gripper that stopped at this position has nothing between its fingers."""
        return (position - self.gripper_open) / (self.gripper_closed - self.gripper_open) >= 1 - self.held_margin

    @classmethod
    def read(cls, lookup: Lookup) -> Self:
        """Declare and read every parameter.

        Raises:
            ConfigError: As above.
        """
        values: dict[str, Any] = {}
        for f in fields(cls):
            if f.metadata.get("declared", True):
                default = list(f.default) if isinstance(f.default, tuple) else f.default
                values[f.name] = _typed(f.name, lookup(f.name, default), default)
        cameras = tuple(CameraParameters.read(name, lookup) for name in values["cameras"])
        return cls(**values, camera_parameters=cameras)


def _typed(name: str, value: Any, default: Any) -> Any:
    """The value as its default's type; a file may say 1 for 1.0."""
    if isinstance(default, list):
        if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__iter__"):
            raise ConfigError(f"parameter {name} must be a list, got {value!r}")
        return tuple(_element(name, item) for item in value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        raise ConfigError(f"parameter {name} must be a {type(default).__name__}, got {value!r}")
    return value


def _element(name: str, item: Any) -> Any:
    """An element of a list as its parameter's: names, or numbers; numpy's as Python's own."""
    if name in _NAMES:
        if not isinstance(item, str) or not item:
            raise ConfigError(f"parameter {name} must be a list of names, got {item!r} among them")
        return item
    if isinstance(item, bool | str) or not isinstance(item, SupportsFloat):
        raise ConfigError(f"parameter {name} must be a list of numbers, got {item!r} among them")
    return float(item)
