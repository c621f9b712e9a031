"""The node: rclpy at the edge, and nothing else. All that decides is in the other modules.

Not run where this was written, for want of ROS: see docs/ros2.md.
"""

from __future__ import annotations

import signal
import threading
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from typing import Any

import rclpy
import rclpy.logging
from control_msgs.action import GripperCommand
from message_filters import ApproximateTimeSynchronizer, Subscriber
from moveit_msgs.action import MoveGroup
from moveit_msgs.srv import ApplyPlanningScene
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener
from thinkgrasp_interfaces.action import ClearAndGrasp
from thinkgrasp_interfaces.srv import FindGrasp

from thinkgrasp.errors import ThinkGraspError
from thinkgrasp_ros.cameras import TopicCamera
from thinkgrasp_ros.images import transform_matrix
from thinkgrasp_ros.interface import GripperState, Message, RobotFault, Transform, TransformUnavailable
from thinkgrasp_ros.moveit import CONTROL_FAILED, TIMED_OUT
from thinkgrasp_ros.parameters import Parameters
from thinkgrasp_ros.robot import MoveItRobot
from thinkgrasp_ros.server import GraspServer

_POLL_S = 0.02
_CONNECT_S = 5.0
_QUEUE = 10
_LOOK_S = 0.1
_STOP_S = 8.0
"""A launch file kills ten seconds after Ctrl-C."""
_INTERNAL = "internal error, see the node's log; look at the robot before you go on"
_STATUS_SUCCEEDED = 4  # action_msgs/msg/GoalStatus.STATUS_SUCCEEDED


class RosMessages:
    """Makes messages of the installed packages."""

    def new(self, name: str) -> Message:
        """Return one by its name, "package/kind/Name"; goals, results and feedback as "package/action/Name_Goal"."""
        package, kind, name = name.split("/")
        outer, _, inner = name.partition("_") if kind == "action" else (name, "", "")
        found = getattr(import_module(f"{package}.{kind}"), outer)
        return (getattr(found, inner) if inner else found)()


class RosClock:
    """The node's clock."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._node.get_clock().now().nanoseconds


class RosTransforms:
    """tf2."""

    def __init__(self, node: Node, timeout_s: float) -> None:
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, node)
        self._timeout = Duration(seconds=timeout_s)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return T_target_source at a time, as `Transforms.lookup`."""
        try:
            found = self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns), timeout=self._timeout)
        except TransformException as error:
            raise TransformUnavailable(
                f"the pose of {source!r} in {target!r} at the images' time is not known to tf2: {error}"
            ) from error
        return transform_matrix(found.transform)


class _Client:
    """Sends a goal, waits for its result, and cancels it when asked to; called from worker threads only."""

    def __init__(
        self, node: Node, kind: Any, name: str, timeout_s: float, what: str, *, stops_in_s: float = 0.0
    ) -> None:
        self._client = ActionClient(node, kind, name, callback_group=ReentrantCallbackGroup())
        self._name = name
        self._timeout_s = timeout_s
        self._what = what
        self._stops_in_s = _CONNECT_S + stops_in_s

    def send(self, goal: Message, cancelled: Callable[[], bool]) -> Any:
        """Return the result with its status."""
        if not self._client.wait_for_server(timeout_sec=_CONNECT_S):
            raise RobotFault(f"no action server {self._name} ({self._what}); is it started, and the name right?")
        answer = self._client.send_goal_async(goal)
        handle = _wait(answer, _CONNECT_S, lambda: False)
        if handle is None:
            answer.add_done_callback(_cancel)  # accepted later, it would move with nobody waiting for it
            raise RobotFault(f"{self._name} ({self._what}) did not answer in {_CONNECT_S:g} s")
        if not handle.accepted:
            raise RobotFault(f"{self._name} ({self._what}) rejects the goal")
        future = handle.get_result_async()
        found = _wait(future, self._timeout_s, cancelled)
        if found is None:
            handle.cancel_goal_async()
            found = _wait(future, self._stops_in_s, lambda: False)
            if not cancelled():
                raise RobotFault(f"{self._name} ({self._what}) was not done in {self._timeout_s:g} s; it was cancelled")
        if found is None:
            raise RobotFault(f"{self._name} ({self._what}) does not stop although it was cancelled")
        return found


class RosMotions(_Client):
    """MoveIt's move_group."""

    def __init__(self, node: Node, parameters: Parameters) -> None:
        super().__init__(
            node,
            MoveGroup,
            parameters.move_group_action,
            parameters.motion_timeout_s,
            "MoveIt",
            stops_in_s=parameters.planning_time_s,  # a planner is not interrupted
        )

    def move(self, goal: Message, cancelled: Callable[[], bool]) -> int:
        """Carry out a goal, as `MotionClient.move`.

        MoveIt says TIMED_OUT of planners, and of a controller that did not bring the arm along in time; where there
        was a plan it is the latter, and CONTROL_FAILED is returned.
        """
        result = self.send(goal, cancelled).result
        code = int(result.error_code.val)
        planned = len(result.planned_trajectory.joint_trajectory.points) > 0
        return CONTROL_FAILED if code == TIMED_OUT and planned else code


class RosScene:
    """MoveIt's planning scene."""

    def __init__(self, node: Node, parameters: Parameters) -> None:
        self._name = parameters.scene_service
        self._client = node.create_client(ApplyPlanningScene, self._name, callback_group=ReentrantCallbackGroup())

    def apply(self, scene: Message) -> bool:
        """Apply a difference, as `SceneClient.apply`."""
        if not self._client.wait_for_service(timeout_sec=_CONNECT_S):
            raise RobotFault(f"no service {self._name} (MoveIt); is it started, and the name right?")
        request = ApplyPlanningScene.Request()
        request.scene = scene
        answer = _wait(self._client.call_async(request), _CONNECT_S, lambda: False)
        if answer is None:
            raise RobotFault(f"{self._name} (MoveIt) did not answer in {_CONNECT_S:g} s")
        return bool(answer.success)


class RosGripper(_Client):
    """The gripper's action."""

    def __init__(self, node: Node, parameters: Parameters) -> None:
        super().__init__(node, GripperCommand, parameters.gripper_action, parameters.gripper_timeout_s, "gripper")

    def command(self, goal: Message, cancelled: Callable[[], bool]) -> GripperState:
        """Carry out a goal, as `GripperClient.command`; one that aborts because it stalled has done its work."""
        found = self.send(goal, cancelled)
        result = found.result
        stalled = bool(result.stalled)
        if found.status != _STATUS_SUCCEEDED and not stalled and not cancelled():
            raise RobotFault(f"{self._name} (gripper) failed with status {found.status}")
        return GripperState(float(result.position), stalled, bool(result.reached_goal))


class ThinkGraspNode(Node):
    """Service `~/find_grasp`, action `~/clear_and_grasp`."""

    def __init__(self) -> None:
        super().__init__("thinkgrasp")
        self._parameters = Parameters.read(self._parameter)
        messages, clock = RosMessages(), RosClock(self)
        transforms = RosTransforms(self, self._parameters.tf_timeout_s)
        motions, gripper = RosMotions(self, self._parameters), RosGripper(self, self._parameters)
        scene = RosScene(self, self._parameters)
        cameras = [TopicCamera(c, self._parameters, transforms, clock) for c in self._parameters.camera_parameters]
        self._synchronisers = [self._subscribe(camera) for camera in cameras]
        self._server = GraspServer(
            self._parameters,
            messages,
            cameras,
            lambda cancelled: MoveItRobot(self._parameters, messages, motions, scene, gripper, cancelled),
        )
        self._stopping = threading.Event()
        group = ReentrantCallbackGroup()
        self.create_service(FindGrasp, "~/find_grasp", self._find_grasp, callback_group=group)
        self._action = ActionServer(
            self,
            ClearAndGrasp,
            "~/clear_and_grasp",
            execute_callback=self._clear_and_grasp,
            goal_callback=self._accept,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
            callback_group=group,
        )
        if not self._parameters.touch_links:
            self.get_logger().warning("the parameter touch_links is empty: MoveIt is not told what is held")
        self.get_logger().info(
            f"ready: preset {self._parameters.preset}, cameras {', '.join(self._parameters.cameras)}"
        )

    @property
    def is_stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stopping.is_set()

    @property
    def is_busy(self) -> bool:
        """Whether a request is being served."""
        return self._server.is_busy

    def stop(self) -> None:
        """Cancel what is being done, the motion in progress included; callbacks must go on being run meanwhile."""
        self._stopping.set()

    def _parameter(self, name: str, default: Any) -> Any:
        # An empty list has no type of its own in rclpy, and a file may write 1 for 1.0: Parameters checks both.
        return self.declare_parameter(name, default, ParameterDescriptor(dynamic_typing=True)).value

    def _subscribe(self, camera: TopicCamera) -> ApproximateTimeSynchronizer:
        group = MutuallyExclusiveCallbackGroup()
        topics = ((Image, camera.camera.color_topic), (Image, camera.camera.depth_topic))
        topics += ((CameraInfo, camera.camera.info_topic),)
        sources = [
            Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data, callback_group=group)
            for kind, topic in topics
        ]
        synchroniser = ApproximateTimeSynchronizer(sources, _QUEUE, self._parameters.sync_slop_s)
        synchroniser.registerCallback(camera.feed)
        return synchroniser

    def _accept(self, request: Message) -> GoalResponse:
        if self.is_busy or self.is_stopping:
            self.get_logger().warning("a goal is rejected: another request is being served")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _find_grasp(self, request: Message, response: Message) -> Message:
        try:
            return self._server.find_grasp(request, response)
        except Exception:  # rclpy would end the node
            self.get_logger().error(traceback.format_exc())
            response.status, response.message = "error", _INTERNAL
            return response

    def _clear_and_grasp(self, handle: Any) -> Message:
        result = ClearAndGrasp.Result()
        try:
            self._server.clear_and_grasp(
                handle.request,
                result,
                cancelled=lambda: handle.is_cancel_requested or self.is_stopping,
                publish=handle.publish_feedback,
            )
        except Exception:  # rclpy would answer with an empty result
            self.get_logger().error(traceback.format_exc())
            result.success, result.end, result.message = False, "error", _INTERNAL
        self.get_logger().info(
            f"{handle.request.instruction!r}: {result.end} after {result.attempts}: {result.message}"
        )
        if result.end == "error" or self.is_stopping:
            handle.abort()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.succeed()
        return result


def _cancel(answer: Any) -> None:
    """Cancel a goal whose acceptance was not waited for any longer."""
    handle = answer.result()
    if handle is not None and handle.accepted:
        handle.cancel_goal_async()


def _wait(future: Any, timeout_s: float, cancelled: Callable[[], bool]) -> Any:
    """The future's result, which other threads bring about; None where it was cancelled first, or took longer."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    left = timeout_s
    while not done.wait(_POLL_S):
        left -= _POLL_S
        if left <= 0 or cancelled():
            return None
    return future.result()


def main() -> None:
    """Run the node until it is told to stop; then cancel what moves, and wait until it stands."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own end all communication before the arm stands
    try:
        node = ThinkGraspNode()
    except ThinkGraspError as error:
        rclpy.logging.get_logger("thinkgrasp").fatal(str(error))
        rclpy.try_shutdown()
        raise SystemExit(2) from None
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.stop())
    executor = MultiThreadedExecutor(num_threads=6)
    executor.add_node(node)
    try:
        while not node.is_stopping:
            executor.spin_once(timeout_sec=_LOOK_S)
        deadline = time.monotonic() + _STOP_S
        while node.is_busy and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=_LOOK_S)
        if node.is_busy:
            node.get_logger().error(f"what was being done did not stop in {_STOP_S:g} s: look at the robot")
    except ExternalShutdownException:
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()
