"""A robot behind MoveIt and a gripper action, as `thinkgrasp.loop` knows one."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import apply, deproject, make_transform
from thinkgrasp.types import Frame, Grasp, Outcome, Scene
from thinkgrasp_ros.held import HeldBox, held_box
from thinkgrasp_ros.interface import (
    GripperClient,
    GripperState,
    Message,
    Messages,
    MotionClient,
    RobotFault,
    SceneClient,
    Transform,
)
from thinkgrasp_ros.moveit import (
    SUCCESS,
    gripper_goal,
    joint_goal,
    obstacle_cubes,
    outcome_of,
    pose_goal,
    scene_empty_handed,
    scene_holding,
)
from thinkgrasp_ros.parameters import Parameters

_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Two fingers are the same turned about the approach."""
_SHORT_M = 0.004
"""By so much less than asked for a gripper may open: half of the room that grasps leave beside a thing."""


class MoveItRobot:
    """Carries a grasp out: open, to the pre-grasp, straight in, close, straight up, over the place, open, home.

    What is held is asked for after the lift and before it is let go: closing once more, the gripper must stall before
    it is closed. An attempt that fails puts back what it holds, where that was, and goes home; from among the things it
    leaves the way it came. On its way to the place MoveIt knows what is held, as a box on the gripper.

    Args:
        parameters: Of the node.
        messages: Makes messages.
        motions: MoveIt.
        scene: Its planning scene.
        gripper: The gripper's action.
        cancelled: Asked all the while; when it turns True the motion is cancelled and nothing else is moved.

    Raises:
        ConfigError: The parameters name no joints for home and place.
    """

    def __init__(
        self,
        parameters: Parameters,
        messages: Messages,
        motions: MotionClient,
        scene: SceneClient,
        gripper: GripperClient,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        if not parameters.joint_names:
            raise ConfigError(
                "the parameters joint_names, home_joints and place_joints say where the robot waits and where it lets "
                "things go; without them nothing is executed"
            )
        self.cancelled = cancelled
        self._parameters = parameters
        self._messages = messages
        self._motions = motions
        self._scene = scene
        self._gripper = gripper
        self._hangs: bool | None = None
        """Whether MoveIt has something hanging on the gripper; None = not known, from before."""

    def go_home(self) -> None:
        """Go home, as the cameras must see the table; not at all where it was cancelled.

        Raises:
            ConfigError, RobotFault: As `execute`.
        """
        with suppress(_Ended):
            self._home()

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        """Carry out a grasp given in the frame's camera coordinates.

        Returns:
            "held" when the thing was let go over the place; else "missed", "slipped", "unreachable", "collision", or
            "preempted" when it was cancelled, with the robot where it stopped.

        Raises:
            InputError: The frame's camera pose is unknown, or the grasp is not finite.
            ConfigError: A parameter does not fit the robot.
            RobotFault: Robot, driver or MoveIt failed.
        """
        if frame.T_world_camera is None:
            raise InputError("the robot needs the camera's pose: T_world_camera is missing in the frame")
        T_world_tcp = frame.T_world_camera @ make_transform(grasp.rotation, grasp.position)
        cloud = apply(frame.T_world_camera, Scene(frame, deproject(frame.depth, frame.camera)).cloud())
        try:
            return self._attempt(T_world_tcp, grasp.width_m, cloud)
        except _Ended as end:
            return Outcome(False, end.reason)

    def _attempt(self, T_world_tcp: Transform, width_m: float, cloud: NDArray[np.floating]) -> Outcome:
        self._open(width_m)
        self._let_go()
        obstacles = obstacle_cubes(cloud, self._parameters, [T_world_tcp[:3, 3]])
        T = self._to_pregrasp(T_world_tcp, obstacles)
        raised = _raised(T, self._parameters.lift_m)
        self._move(self._pose(T, straight=True), or_else=lambda _: self._back_off(T))
        if self._is_empty(self._command(0.0)):
            self._leave(T)
            return Outcome(False, "missed")
        self._move(self._pose(raised, straight=True), or_else=lambda _: self._put_back(T))
        if self._is_empty(self._command(0.0)):
            self._home()
            return Outcome(False, "slipped")
        obstacles = self._hang(held_box(cloud, T, width_m, self._parameters.clear_m), raised, obstacles)

        def put_back(reason: str) -> None:
            if reason == "collision":  # stopped on its way: the straight way down begins above where the thing was
                self._surely(self._pose(raised, obstacles=obstacles), "carry back what it holds")
            self._let_go()
            self._put_back(T)

        self._move(self._joints(self._parameters.place_joints, obstacles), or_else=put_back)
        held = not self._is_empty(self._command(0.0))
        self._command(self._parameters.stroke_m)
        self._let_go()
        self._home()
        return Outcome(held, "held" if held else "slipped")

    def _to_pregrasp(self, T_world_tcp: Transform, obstacles: NDArray[np.float64] | None) -> Transform:
        """Move to the pre-grasp by RRT*; return the grasp as it is reached: as it is, or turned by half a turn."""
        for T in (T_world_tcp, T_world_tcp @ _HALF_TURN):
            reason = self._reason(self._pose(_backed(T, self._parameters.standoff_m), obstacles=obstacles))
            if reason is None:
                return T
            if reason == "collision":
                self._home()
            if reason != "unreachable":
                raise _Ended(reason)
        raise _Ended("unreachable")

    def _hang(
        self, box: HeldBox, T_world_tcp: Transform, obstacles: NDArray[np.float64] | None
    ) -> NDArray[np.float64] | None:
        """Tell MoveIt what is held, and return the obstacles without those that it is in as the arm stands."""
        if not self._parameters.touch_links:
            return obstacles
        if not self._scene.apply(scene_holding(self._messages, self._parameters, box)):
            raise RobotFault("MoveIt does not take what is held into its scene (tcp_link?); the arm holds it still")
        self._hangs = True
        reach = self._parameters.obstacle_m * np.sqrt(3) / 2
        return None if obstacles is None else box.outside(obstacles, T_world_tcp, reach)

    def _let_go(self) -> None:
        """Tell MoveIt that nothing is held; what was held when an action was cancelled is known to MoveIt alone."""
        if not self._parameters.touch_links or self._hangs is False:
            return
        taken = self._scene.apply(scene_empty_handed(self._messages, self._parameters))
        if self._hangs and not taken:
            raise RobotFault("MoveIt does not take what was held out of its scene; plans would go on minding it")
        self._hangs = False

    def _put_back(self, T: Transform) -> None:
        """Down again to where the thing was taken, and leave."""
        self._surely(self._pose(T, straight=True), "put down what it holds")
        self._leave(T)

    def _leave(self, T: Transform) -> None:
        """Open, back off and go home."""
        self._command(self._parameters.stroke_m)
        self._back_off(T)

    def _back_off(self, T: Transform) -> None:
        """Out from among the things, straight, and home."""
        self._surely(self._pose(_backed(T, self._parameters.standoff_m), straight=True), "back off")
        self._home()

    def _home(self) -> None:
        self._surely(self._joints(self._parameters.home_joints, None), "go home")

    def _reason(self, goal: Message) -> str | None:
        """Move, and return why that did not come about; None where it did."""
        if self.cancelled():
            return "preempted"
        code = self._motions.move(goal, self.cancelled)
        if code != SUCCESS and self.cancelled():
            return "preempted"
        reason = outcome_of(code)
        if reason == "preempted":
            raise RobotFault("another client of MoveIt took the arm over in mid-motion; it stands where that left it")
        return reason

    def _surely(self, goal: Message, what: str) -> None:
        """Move; where that fails, somebody has to look, for the arm stands in the way."""
        reason = self._reason(goal)
        if reason == "preempted":
            raise _Ended(reason)
        if reason is not None:
            raise RobotFault(f"the robot could not {what} ({reason}); it stands where it stopped")

    def _move(self, goal: Message, *, or_else: Callable[[str], None]) -> None:
        """Move; where that fails and nobody cancelled, do something else, told why, before the attempt ends."""
        reason = self._reason(goal)
        if reason is None:
            return
        if reason != "preempted":
            or_else(reason)
        raise _Ended(reason)

    def _open(self, width_m: float) -> None:
        """Open to a width; fingers that stand closer than the collision check took them for must not go down."""
        state = self._command(width_m)
        wanted = min(width_m, self._parameters.stroke_m)
        stands = self._parameters.opening_m(state.position)
        if stands < wanted - _SHORT_M:
            raise RobotFault(f"the gripper should be open by {wanted * 1e3:.0f} mm and says {stands * 1e3:.0f} mm")

    def _command(self, width_m: float) -> GripperState:
        if self.cancelled():
            raise _Ended("preempted")
        goal = gripper_goal(self._messages, self._parameters, width_m)
        state = self._gripper.command(goal, self.cancelled)
        if self.cancelled():
            raise _Ended("preempted")
        if not math.isfinite(state.position):
            raise RobotFault(f"the gripper's controller reports the position {state.position}")
        return state

    def _is_empty(self, state: GripperState) -> bool:
        return not state.stalled or self._parameters.is_closed(state.position)

    def _pose(self, T: Transform, *, straight: bool = False, obstacles: NDArray[np.float64] | None = None) -> Message:
        return pose_goal(self._messages, self._parameters, T, straight=straight, obstacles=obstacles)

    def _joints(self, joints_rad: object, obstacles: NDArray[np.float64] | None) -> Message:
        return joint_goal(self._messages, self._parameters, joints_rad, obstacles=obstacles)  # type: ignore[arg-type]


class _Ended(Exception):
    """A motion did not come about, for a named reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def _backed(T: Transform, by_m: float) -> Transform:
    """The pose moved back along its approach."""
    moved = T.copy()
    moved[:3, 3] -= by_m * T[:3, 2]
    return moved


def _raised(T: Transform, by_m: float) -> Transform:
    """The pose moved up."""
    moved = T.copy()
    moved[2, 3] += by_m
    return moved
