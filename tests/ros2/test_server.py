"""The service and the action over fakes: the loop of thinkgrasp with cameras of topics and a robot behind MoveIt."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
from fakes.ros import (
    FakeClock,
    FakeGripper,
    FakeMessages,
    FakeMotions,
    FakeScene,
    FakeTransforms,
    Strict,
    camera_info,
    image,
    parameters,
)
from fakes.stages import FakeCheck, fake_pipeline
from fakes.table_loop import POSE, FakeTable
from thinkgrasp_ros.cameras import TopicCamera
from thinkgrasp_ros.robot import MoveItRobot
from thinkgrasp_ros.server import GraspServer, loop_config

from thinkgrasp.errors import ConfigError
from thinkgrasp.loop import END_WORDS
from thinkgrasp.types import Frame

BLUE_AT, RED_AT = 0.12, -0.12


class LiveCamera(TopicCamera):
    """Topics on which new images come whenever someone looks."""

    def __init__(self, table: FakeTable, told, clock: FakeClock, index: int = 0) -> None:
        self.table, self.clock = table, clock
        self.pose = POSE.copy()
        self.pose[0, 3] = 0.05 * index
        name = f"optical{index}"
        super().__init__(told.camera_parameters[index], told, FakeTransforms({name: self.pose}), clock)
        self.frame_name = name

    def read(self) -> Frame:
        self.clock.ns += 40_000_000
        frame, ns = self.table.frame(self.pose), self.clock.ns
        depth = np.rint(frame.depth * 1000).astype(np.uint16)
        self.feed(
            image(frame.color, "rgb8", ns, frame=self.frame_name),
            image(depth, "16UC1", ns, frame=self.frame_name),
            camera_info(frame.camera, ns, frame=self.frame_name),
        )
        return super().read()


class Cell:
    """A table, cameras above it, a robot that takes what it closes on."""

    def __init__(self, *, cameras: int = 1, script=(), widths=(0.03,), pipeline=None, **changes) -> None:
        self.told = parameters(cameras=tuple(f"c{i}" for i in range(cameras)), **changes)
        self.table, self.clock = FakeTable(), FakeClock()
        self.motions = FakeMotions(list(script), before=self._moved)
        self.gripper = FakeGripper(self.told, list(widths))
        self.cameras = [LiveCamera(self.table, self.told, self.clock, i) for i in range(cameras)]
        self.cancelled = False
        self.feedback: list[Strict] = []
        self.on_motion = lambda n: None
        self.scene = FakeScene()
        self.server = GraspServer(self.told, FakeMessages(), self.cameras, self._robot, pipeline or fake_pipeline())

    def _robot(self, cancelled) -> MoveItRobot:
        return MoveItRobot(self.told, FakeMessages(), self.motions, self.scene, self.gripper, cancelled)

    def _moved(self, n: int) -> None:
        self.on_motion(n)
        goals = self.motions.goals
        if (
            goals
            and goals[-1].request.planner_id == "LIN"
            and not goals[-1].request.goal_constraints[0].joint_constraints
        ):
            at = (
                goals[-1]
                .request.goal_constraints[0]
                .position_constraints[0]
                .constraint_region.primitive_poses[0]
                .position
            )
            if at.z > -0.58 and self.gripper.widths_m[0] > 0:  # lifted
                self.table.there.discard("red" if at.x < 0 else "blue")

    def find(self, instruction: str, *, fuse_views: bool = False) -> Strict:
        request = Strict("thinkgrasp_interfaces/srv/FindGrasp_Request")
        request.instruction, request.fuse_views = instruction, fuse_views
        response = self.server.find_grasp(request, Strict("thinkgrasp_interfaces/srv/FindGrasp_Response"))
        assert response.bytes()
        return response

    def act(self, instruction: str, step_limit: int = 0) -> Strict:
        goal = Strict("thinkgrasp_interfaces/action/ClearAndGrasp_Goal")
        goal.instruction, goal.step_limit = instruction, step_limit
        result = self.server.clear_and_grasp(
            goal,
            Strict("thinkgrasp_interfaces/action/ClearAndGrasp_Result"),
            cancelled=lambda: self.cancelled,
            publish=self.feedback.append,
        )
        assert result.bytes()
        assert all(f.bytes() for f in self.feedback)
        return result


def test_find_grasp_answers_in_the_world_frame():
    cell = Cell()
    response = cell.find("the red block")
    assert (response.status, response.message) == ("grasp", "its colour fits")
    tcp, pregrasp = response.grasp.tcp, response.grasp.pregrasp
    assert tcp.header.frame_id == pregrasp.header.frame_id == "base_link"
    assert tcp.pose.position.x < 0
    assert tcp.pose.position.z == pytest.approx(-0.70, abs=1e-3)
    assert pregrasp.pose.position.z == pytest.approx(-0.60, abs=1e-3)
    o = tcp.pose.orientation
    assert abs(o.x) == pytest.approx(1), "down: the camera's axes, which look down"
    assert 0 < len(response.alternatives) <= 10
    decision = json.loads(response.decision_json)
    assert decision["schema"] == "thinkgrasp/decision-1"
    assert decision["grasp"]["frame"] == "world"
    assert decision["grasp"]["position_m"] == pytest.approx(
        [tcp.pose.position.x, tcp.pose.position.y, tcp.pose.position.z], abs=1e-5
    )
    assert not cell.motions.goals


def test_find_grasp_on_all_views():
    seen = []

    class Noting(FakeCheck):
        def keep(self, scene, target, grasps, gripper):
            seen.append(scene.frame.others is not None)
            return super().keep(scene, target, grasps, gripper)

    cell = Cell(cameras=2, pipeline=fake_pipeline(checks={"noting": Noting()}))
    assert cell.find("the red block", fuse_views=True).status == "grasp"
    assert cell.find("the red block").status == "grasp"
    assert seen == [True, False]


def test_what_is_not_found_is_an_answer():
    assert Cell().find("the green block").status == "no_target"
    none = Cell(pipeline=fake_pipeline(checks={"none": FakeCheck(2.0)})).find("the red block")
    assert (none.status, len(none.alternatives)) == ("no_grasp", 0)
    assert none.decision_json


def test_what_goes_wrong_is_an_answer_too():
    cell = Cell()
    assert cell.find(" ").status == "error"
    assert "instruction is empty" in cell.find(" ").message
    cell.clock.ns += 10**9
    cell.cameras[0].read = lambda: TopicCamera.read(cell.cameras[0])  # type: ignore[method-assign]
    frozen = cell.find("the red block")
    assert frozen.status == "error"
    assert "no new images in 0.3 s" in frozen.message


def test_the_action_runs_the_loop_until_the_goal_is_delivered():
    cell = Cell()
    result = cell.act("the red block")
    assert (result.success, result.end, result.attempts) == (True, "goal_delivered", 1)
    assert result.message == END_WORDS["goal_delivered"]
    assert cell.table.there == {"blue"}
    (step,) = cell.feedback
    assert (step.step, step.status, step.target, step.role, step.outcome) == (1, "grasp", "red", "goal", "held")
    assert json.loads(step.decision_json)["status"] == "grasp"


def test_after_a_miss_it_looks_again_and_tries_another_grasp():
    cell = Cell(widths=[0.0, 0.03])
    result = cell.act("the red block")
    assert (result.success, result.attempts) == (True, 2)
    assert [f.outcome for f in cell.feedback] == ["missed", "held"]
    assert [f.step for f in cell.feedback] == [1, 2]


@pytest.mark.parametrize(
    ("cell", "instruction", "limit", "end", "attempts"),
    [
        ({"script": [1] + [-1] * 40}, "the red block", 2, "step_limit", 2),
        ({"script": [1] + [-1] * 40, "step_limit": 3}, "the red block", 0, "step_limit", 3),
        ({}, "the green block", 0, "nothing_left", 0),
        ({"pipeline": fake_pipeline(checks={"none": FakeCheck(2.0)})}, "the red block", 0, "no_grasp", 0),
    ],
)
def test_every_end_is_named(cell, instruction, limit, end, attempts):
    result = Cell(**cell).act(instruction, limit)
    assert (result.success, result.end, result.attempts) == (False, end, attempts)


def test_the_loop_fuses_the_cameras_views_where_one_shows_no_grasp():
    class OnFused(FakeCheck):
        def keep(self, scene, target, grasps, gripper):
            return np.full(len(grasps), scene.frame.others is not None)

    cell = Cell(cameras=2, pipeline=fake_pipeline(checks={"fused": OnFused()}))
    assert cell.act("the red block").success
    assert (
        not Cell(cameras=2, pipeline=fake_pipeline(checks={"fused": OnFused()}), fusion="never")
        .act("the red block")
        .success
    )


def test_a_cancel_in_mid_motion_ends_the_episode_after_that_motion():
    cell = Cell()
    cell.on_motion = lambda n: setattr(cell, "cancelled", n == 1)
    result = cell.act("the red block")
    assert (result.success, result.end, result.attempts) == (False, "stopped", 1)
    assert cell.feedback[0].outcome == "preempted"
    assert len(cell.motions.goals) == 2


def test_an_action_begins_at_home_and_not_at_all_without_an_instruction():
    cell = Cell()
    first = cell.cameras[0].read
    moved = []
    cell.cameras[0].read = lambda: (moved.append(len(cell.motions.goals)), first())[1]  # type: ignore[method-assign]
    cell.act("the red block")
    assert moved[0] == 1, "the arm is out of the way before the first look"
    assert cell.motions.goals[0].request.goal_constraints[0].joint_constraints[0].position == 0.0
    empty = Cell()
    assert empty.act(" ").end == "error"
    assert not empty.motions.goals
    stuck = Cell(script=[-1]).act("the red block")
    assert (stuck.end, stuck.attempts) == ("error", 0)
    assert "could not go home" in stuck.message


def test_a_cancel_before_the_first_look():
    cell = Cell()
    cell.cancelled = True
    assert (cell.act("the red block").end, len(cell.motions.goals)) == ("stopped", 0)


def test_a_fault_ends_the_episode_and_is_told():
    cell = Cell(script=[1, 1, 1, 1, 1, 1, -4], widths=[0.0, 0.03])
    result = cell.act("the red block")
    assert (result.success, result.end, result.attempts) == (False, "error", 1)
    assert "CONTROL_FAILED (-4); look at the robot" in result.message


def test_a_robot_that_is_not_set_up_moves_nothing():
    result = Cell(joint_names=(), home_joints=(), place_joints=()).act("the red block")
    assert result.end == "error"
    assert "joint_names, home_joints and place_joints" in result.message


def test_one_request_at_a_time():
    cell, inside, go_on = Cell(), threading.Event(), threading.Event()
    cell.on_motion = lambda n: (inside.set(), go_on.wait(5))
    thread = threading.Thread(target=cell.act, args=("the red block",))
    thread.start()
    assert inside.wait(5)
    assert cell.server.is_busy
    assert cell.find("the red block").message.startswith("busy")
    other = cell.server.clear_and_grasp(
        Strict("thinkgrasp_interfaces/action/ClearAndGrasp_Goal"),
        Strict("thinkgrasp_interfaces/action/ClearAndGrasp_Result"),
        cancelled=lambda: False,
        publish=lambda m: None,
    )
    assert (other.end, other.message[:4]) == ("error", "busy")
    go_on.set()
    thread.join(10)
    assert not cell.server.is_busy
    assert cell.find("the blue block").status == "grasp"


def test_the_configuration_is_the_loops():
    config = loop_config(parameters())
    assert config.planner.settings == {"search": "all"}
    assert {c.name: dict(c.settings) for c in config.checks}["collision"] == {"support_noise_m": 0.003}
    assert "reach" not in {c.name for c in config.checks}, "what the arm reaches is MoveIt's to say"
    told = loop_config(parameters(settings=("planner.search=none", "seed=4"), gripper="franka_hand"))
    assert (told.planner.settings["search"], told.seed, told.gripper) == ("none", 4, "franka_hand")
    with pytest.raises(ConfigError, match="no preset 'nonsense'"):
        loop_config(parameters(preset="nonsense"))
    with pytest.raises(ConfigError, match="fusion must be one of never, first, last, always"):
        Cell(fusion="sometimes")
