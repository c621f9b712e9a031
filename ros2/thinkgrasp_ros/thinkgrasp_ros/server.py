"""What the service and the action do: requests in, answers out. One at a time, for there is one robot."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import cast, get_args

from thinkgrasp.config import PipelineConfig, load_config, make_pipeline, override, parse_assignment
from thinkgrasp.errors import ConfigError, ThinkGraspError
from thinkgrasp.fusion import fuse
from thinkgrasp.geometry import apply, quat_wxyz
from thinkgrasp.loop import END_WORDS, Fusion, run_episode
from thinkgrasp.pipeline import Pipeline, check_instruction
from thinkgrasp.schema import decision_to_schema
from thinkgrasp.types import Decision, Frame, Grasp, Outcome
from thinkgrasp_ros.cameras import TopicCamera
from thinkgrasp_ros.interface import Message, Messages
from thinkgrasp_ros.parameters import Parameters
from thinkgrasp_ros.robot import MoveItRobot

MAX_ALTERNATIVES = 10
BUSY = "busy: another request is being served"


def loop_config(parameters: Parameters) -> PipelineConfig:
    """Return the configuration that the node runs.

    As for the simulated robot, a planner of ours goes on clearing while the goal is not in view, and the table's noise
    keeps no finger away; what the arm reaches is MoveIt's to say. Settings that were made stay.

    Raises:
        ConfigError: The preset or a setting is not allowed.
    """
    config = override(load_config(parameters.preset), "gripper", parameters.gripper)
    wanted = dict(parse_assignment(text) for text in parameters.settings)
    if config.planner.name in ("offline", "openai") and "search" not in config.planner.settings:
        wanted.setdefault("planner.search", "all")
    if any(check.name == "collision" for check in config.checks):
        wanted.setdefault("checks.collision.support_noise_m", 0.003)
    for key, value in wanted.items():
        config = override(config, key, value)
    return config


class GraspServer:
    """Serves FindGrasp and ClearAndGrasp.

    Args:
        parameters: Of the node.
        messages: Makes messages.
        cameras: In the order of the parameter cameras.
        make_robot: Makes the robot for one goal, given what says that it was cancelled.
        pipeline: By default that of `loop_config`.

    Raises:
        ConfigError: The parameters allow no pipeline, or name no such fusion.
    """

    def __init__(
        self,
        parameters: Parameters,
        messages: Messages,
        cameras: Sequence[TopicCamera],
        make_robot: Callable[[Callable[[], bool]], MoveItRobot],
        pipeline: Pipeline | None = None,
    ) -> None:
        if parameters.fusion not in get_args(Fusion):
            raise ConfigError(
                f"parameter fusion must be one of {', '.join(get_args(Fusion))}, got {parameters.fusion!r}"
            )
        self._parameters = parameters
        self._messages = messages
        self._cameras = tuple(cameras)
        self._make_robot = make_robot
        self._pipeline = pipeline or make_pipeline(loop_config(parameters))
        self._at_work = threading.Lock()

    @property
    def is_busy(self) -> bool:
        """Whether a request is being served; further ones are refused."""
        return self._at_work.locked()

    def find_grasp(self, request: Message, response: Message) -> Message:
        """Answer a FindGrasp request; never raises for what a request, a camera or a frame can bring about."""
        if not self._at_work.acquire(blocking=False):
            return _refused(response, BUSY)
        try:
            frames = [camera.read() for camera in (self._cameras if request.fuse_views else self._cameras[:1])]
            decision = self._pipeline.decide(fuse(frames), request.instruction)
        except ThinkGraspError as error:
            return _refused(response, str(error))
        finally:
            self._at_work.release()
        response.status = decision.status
        response.message = decision.plan.rationale
        if decision.grasp is not None:
            response.grasp = self._grasp(decision.grasp, decision.scene.frame)
            others = decision.alternatives[:MAX_ALTERNATIVES]
            response.alternatives = [self._grasp(grasp, decision.scene.frame) for grasp in others]
        response.decision_json = _json(decision)
        return response

    def clear_and_grasp(
        self,
        goal: Message,
        result: Message,
        *,
        cancelled: Callable[[], bool],
        publish: Callable[[Message], None],
    ) -> Message:
        """Carry out a ClearAndGrasp goal with the loop of `thinkgrasp.loop`, from home, and fill in its result.

        Args:
            goal: What was asked.
            result: To be filled in.
            cancelled: Whether whoever asked has cancelled.
            publish: Takes feedback, once per finished step.
        """
        if not self._at_work.acquire(blocking=False):
            return _failed(result, BUSY)
        attempts = _Feedback(self._messages, publish)
        try:
            instruction = check_instruction(goal.instruction)
            robot = self._make_robot(cancelled)
            robot.go_home()
            episode = run_episode(
                self._cameras,
                self._pipeline,
                robot,
                instruction,
                step_limit=int(goal.step_limit) or self._parameters.step_limit,
                recorders=[attempts],
                stop=cancelled,
                fusion=cast(Fusion, self._parameters.fusion),
            )
        except ThinkGraspError as error:
            result.attempts = attempts.executed
            return _failed(result, str(error))
        finally:
            self._at_work.release()
        result.success = episode.success
        result.end = episode.end
        result.message = END_WORDS[episode.end]
        result.attempts = episode.attempts
        return result

    def _grasp(self, grasp: Grasp, frame: Frame) -> Message:
        """A Grasp message in the world frame."""
        message = self._messages.new("thinkgrasp_interfaces/msg/Grasp")
        T = frame.T_world_camera
        assert T is not None  # TopicCamera frames always have one
        qw, qx, qy, qz = (float(v) for v in quat_wxyz(T[:3, :3] @ grasp.rotation))
        places = {"tcp": grasp.position, "pregrasp": grasp.pregrasp(self._parameters.standoff_m)}
        for name, place in places.items():
            stamped = getattr(message, name)
            stamped.header.frame_id = self._parameters.world_frame
            position, orientation = stamped.pose.position, stamped.pose.orientation
            position.x, position.y, position.z = (float(v) for v in apply(T, place))
            orientation.x, orientation.y, orientation.z, orientation.w = qx, qy, qz, qw
        message.width = float(grasp.width_m)
        message.score = float(grasp.score)
        return message


class _Feedback:
    """A recorder that publishes every finished step."""

    def __init__(self, messages: Messages, publish: Callable[[Message], None]) -> None:
        self._messages = messages
        self._publish = publish
        self._steps = 0
        self.executed = 0

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Publish a step."""
        self._steps += 1
        self.executed += outcome is not None
        message = self._messages.new("thinkgrasp_interfaces/action/ClearAndGrasp_Feedback")
        message.step = self._steps
        message.status = decision.status
        message.target = decision.plan.target
        message.role = decision.plan.role
        message.outcome = "" if outcome is None else outcome.reason
        message.decision_json = _json(decision)
        self._publish(message)


def _json(decision: Decision) -> str:
    return decision_to_schema(decision, with_mask=False).to_json()


def _refused(response: Message, why: str) -> Message:
    response.status = "error"
    response.message = why
    return response


def _failed(result: Message, why: str) -> Message:
    result.success = False
    result.end = "error"
    result.message = why
    return result
