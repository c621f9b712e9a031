"""What the node's logic needs of ROS, as Protocols: `node` keeps them with rclpy, tests with fakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError, ThinkGraspError

Message = Any
"""A ROS message: attributes as in its definition."""
Transform = NDArray[np.float64]
"""(4, 4), T_target_source."""


class TransformUnavailable(InputError):
    """tf2 cannot say how two frames lie to one another at a time."""


class RobotFault(ThinkGraspError):
    """The robot, its driver or MoveIt does not do what it is for; a person has to look before anything goes on."""


@dataclass(frozen=True)
class GripperState:
    """What the gripper's controller reports at the end of a motion."""

    position: float
    """In the controller's unit."""
    stalled: bool
    """It pressed on something."""
    reached_goal: bool


class Messages(Protocol):
    """Makes messages."""

    def new(self, name: str) -> Message:
        """Return a message with the default values of its definition: "geometry_msgs/msg/PoseStamped"."""
        ...


class Clock(Protocol):
    """The node's clock: the system's, or the simulator's with use_sim_time."""

    def now_ns(self) -> int:
        """Return the time [ns]."""
        ...


class Transforms(Protocol):
    """The tree of frames."""

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return T_target_source at that very time; waits a moment for it.

        Raises:
            TransformUnavailable: A frame is unknown, not connected, or not known at that time.
        """
        ...


class MotionClient(Protocol):
    """MoveIt's move_group action."""

    def move(self, goal: Message, cancelled: Callable[[], bool]) -> int:
        """Carry out a MoveGroup goal and return the value of its MoveItErrorCodes; cancels it when asked to.

        Raises:
            RobotFault: No server, or no answer in time.
        """
        ...


class SceneClient(Protocol):
    """MoveIt's service apply_planning_scene."""

    def apply(self, scene: Message) -> bool:
        """Apply a PlanningScene message and return whether MoveIt took all of it.

        Raises:
            RobotFault: No server, or no answer in time.
        """
        ...


class GripperClient(Protocol):
    """A GripperCommand action."""

    def command(self, goal: Message, cancelled: Callable[[], bool]) -> GripperState:
        """Carry out a GripperCommand goal; cancels it when asked to.

        Raises:
            RobotFault: No server, the goal was rejected, or there was no answer in time.
        """
        ...
