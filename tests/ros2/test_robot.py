"""An attempt behind MoveIt: what is moved in which order, how it is verified, and every way that it can end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from fakes.ros import FakeGripper, FakeMessages, FakeMotions, FakeScene, parameters
from fakes.stages import table_frame
from fakes.table_loop import POSE
from scipy.spatial.transform import Rotation
from thinkgrasp_ros.interface import GripperState, RobotFault
from thinkgrasp_ros.robot import MoveItRobot

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.fusion import fuse
from thinkgrasp.geometry import apply, deproject, invert, make_transform
from thinkgrasp.types import Grasp, Outcome

FRAME = table_frame(T_world_camera=POSE)
AT = np.array([-0.12, 0.0, 0.70])
GRASP = Grasp(np.eye(3), AT, 0.06, 0.9)
"""From above in the camera's frame, on the red block."""
WORLD, UP = np.array([-0.12, 0.0, -0.70]), np.array([0.0, 0.0, 1.0])


def place(goal) -> tuple[str, np.ndarray | None]:
    """The planner that a goal asks for, and where it brings the TCP; None for joints."""
    (constraints,) = goal.request.goal_constraints
    if constraints.joint_constraints:
        return goal.request.planner_id, None
    at = constraints.position_constraints[0].constraint_region.primitive_poses[0].position
    return goal.request.planner_id, np.array([at.x, at.y, at.z])


def joints(goal) -> float:
    return goal.request.goal_constraints[0].joint_constraints[0].position


def robot_of(told, motions, gripper, cancelled=lambda: False, scene=None) -> MoveItRobot:
    return MoveItRobot(told, FakeMessages(), motions, scene or FakeScene(), gripper, cancelled)


def run(script=(), widths=(0.03,), cancelled=lambda: False, frame=FRAME, scene=None, **changes):
    told = parameters(**changes)
    motions, gripper = FakeMotions(list(script)), FakeGripper(told, list(widths))
    robot = robot_of(told, motions, gripper, cancelled, scene)
    return robot.execute(GRASP, frame), motions, gripper


def test_an_attempt_that_succeeds():
    outcome, motions, gripper = run()
    assert outcome == Outcome(True, "held")
    there = [place(goal) for goal in motions.goals]
    assert [planner for planner, _ in there] == ["RRTstar", "LIN", "LIN", "RRTstar", "RRTstar"]
    assert np.allclose(there[0][1], WORLD + 0.10 * UP)
    assert np.allclose(there[1][1], WORLD)
    assert np.allclose(there[2][1], WORLD + 0.15 * UP)
    assert [joints(goal) for goal in motions.goals[3:]] == [1.0, 0.0], "the place, then home"
    told = parameters()
    wanted = [told.gripper_position(w) for w in (0.06, 0, 0, 0, 0.085)]
    assert [goal.command.position for goal in gripper.goals] == pytest.approx(wanted)


def test_the_perceived_cloud_is_an_obstacle_on_the_free_ways_alone():
    _, motions, _ = run()
    sizes = [len(goal.planning_options.planning_scene_diff.world.collision_objects) for goal in motions.goals]
    assert sizes == [1, 0, 0, 1, 0]


def test_what_other_cameras_saw_is_an_obstacle_too():
    aside = POSE.copy()
    aside[0, 3] = 0.3
    fused = fuse([FRAME, replace(table_frame(T_world_camera=aside))])
    alone, both = (run(frame=f)[1].goals[0] for f in (FRAME, fused))
    cubes = [len(g.planning_options.planning_scene_diff.world.collision_objects[0].primitives) for g in (alone, both)]
    assert cubes[1] > cubes[0]


@pytest.mark.parametrize(
    ("script", "widths", "reason", "planners"),
    [
        ([-1, -1], [0.03], "unreachable", ["RRTstar", "RRTstar"]),
        ([99999, -31], [0.03], "unreachable", ["RRTstar", "RRTstar"]),
        ([-3], [0.03], "collision", ["RRTstar", "RRTstar"]),
        ([-1, -3], [0.03], "collision", ["RRTstar", "RRTstar", "RRTstar"]),
        ([1, -1], [0.03], "unreachable", ["RRTstar", "LIN", "LIN", "RRTstar"]),
        ([1, -3], [0.03], "collision", ["RRTstar", "LIN", "LIN", "RRTstar"]),
        ([], [0.0], "missed", ["RRTstar", "LIN", "LIN", "RRTstar"]),
        ([], [0.001], "missed", ["RRTstar", "LIN", "LIN", "RRTstar"]),
        ([1, 1, -1], [0.03], "unreachable", ["RRTstar", "LIN", "LIN", "LIN", "LIN", "RRTstar"]),
        ([1, 1, -3], [0.03], "collision", ["RRTstar", "LIN", "LIN", "LIN", "LIN", "RRTstar"]),
        ([], [0.03, 0.0], "slipped", ["RRTstar", "LIN", "LIN", "RRTstar"]),
        ([1, 1, 1, -1], [0.03], "unreachable", ["RRTstar", "LIN", "LIN", "RRTstar", "LIN", "LIN", "RRTstar"]),
        ([], [0.03, 0.03, 0.0], "slipped", ["RRTstar", "LIN", "LIN", "RRTstar", "RRTstar"]),
    ],
)
def test_every_way_to_fail_ends_at_home_with_an_open_gripper(script, widths, reason, planners):
    outcome, motions, gripper = run(script, widths)
    assert outcome == Outcome(False, reason)
    assert [place(goal)[0] for goal in motions.goals] == planners
    if len(planners) > 2 or reason == "collision":
        assert joints(motions.goals[-1]) == 0.0, "home"
    if reason == "missed" or script[:2] == [1, 1]:
        assert gripper.goals[-1].command.position == 0.0


def test_what_cannot_be_carried_is_put_back_where_it_was():
    _, motions, gripper = run([1, 1, 1, -1])
    down = motions.goals[4]
    assert np.allclose(place(down)[1], WORLD)
    assert gripper.goals[-1].command.position == 0.0


def test_a_way_in_that_was_stopped_is_left_the_way_it_came():
    _, motions, _ = run([1, -3])
    assert np.allclose(place(motions.goals[2])[1], WORLD + 0.10 * UP)


def test_a_lift_that_was_stopped_puts_down_before_it_lets_go():
    outcome, motions, gripper = run([1, 1, -3])
    assert outcome.reason == "collision"
    assert np.allclose(place(motions.goals[3])[1], WORLD)
    assert [goal.command.position for goal in gripper.goals][-2:] == [0.8, 0.0], "closed on the way down, then open"


def test_what_was_stopped_on_its_way_to_the_place_goes_back_above_where_it_was_first():
    outcome, motions, _ = run([1, 1, 1, -3])
    assert outcome == Outcome(False, "collision")
    ways = [place(goal) for goal in motions.goals[4:]]
    assert [planner for planner, _ in ways] == ["RRTstar", "LIN", "LIN", "RRTstar"]
    assert np.allclose(ways[0][1], WORLD + 0.15 * UP)
    assert np.allclose(ways[1][1], WORLD)
    assert len(motions.goals[4].planning_options.planning_scene_diff.world.collision_objects) == 1


@dataclass
class StuckGripper(FakeGripper):
    """Stops at a position whatever it is asked for."""

    at: float = 0.8

    def command(self, goal, cancelled):
        self.goals.append(goal)
        return GripperState(self.at, True, False)


@pytest.mark.parametrize(
    ("at", "said"), [(0.8, "open by 60 mm and says 0 mm"), (0.3, "says 53 mm"), (np.nan, "reports the position nan")]
)
def test_a_gripper_that_does_not_open_goes_nowhere(at, said):
    told = parameters()
    motions = FakeMotions()
    robot = robot_of(told, motions, StuckGripper(told, at=at))
    with pytest.raises(RobotFault, match=said):
        robot.execute(GRASP, FRAME)
    assert not motions.goals


def test_a_gripper_that_opens_a_little_less_is_open():
    told = parameters()
    robot = robot_of(told, FakeMotions(), StuckGripper(told, at=told.gripper_position(0.057)))
    assert robot.execute(GRASP, FRAME).success


def test_the_grasp_turned_by_half_a_turn_is_tried_where_the_first_is_out_of_reach():
    outcome, motions, _ = run([-1])
    assert outcome.success
    q = [goal.request.goal_constraints[0].orientation_constraints[0].orientation for goal in motions.goals[:3]]
    first, second, then = (np.array([o.x, o.y, o.z, o.w]) for o in q)
    assert abs(first @ second) < 1e-6, "180 degrees apart"
    assert abs(second @ then) == pytest.approx(1), "and kept for the way in"


@pytest.mark.parametrize("motion", range(5))
def test_a_cancel_stops_everything_where_it_is(motion):
    done = []
    told = parameters()
    motions, gripper = FakeMotions(before=done.append), FakeGripper(told)
    robot = robot_of(told, motions, gripper, lambda: len(done) > motion)
    assert robot.execute(GRASP, FRAME) == Outcome(False, "preempted")
    assert len(motions.goals) == motion + 1, "no motion after it"


TOUCH = ("left_finger", "right_finger")


def hanging(script=(), widths=(0.03,), **changes):
    """What hung on the gripper in each motion, and the rest."""
    scene, hung = FakeScene(), []
    told = parameters(touch_links=TOUCH, **changes)
    motions = FakeMotions(list(script), before=lambda n: hung.append(list(scene.attached.values())))
    robot = robot_of(told, motions, FakeGripper(told, list(widths)), scene=scene)
    outcome = robot.execute(GRASP, FRAME)
    assert not scene.attached, "let go"
    assert not scene.world, "and not left in the world"
    return outcome, [len(things) for things in hung], motions, hung, scene


@pytest.mark.parametrize(
    ("script", "widths", "hung"),
    [
        ([], [0.03], [0, 0, 0, 1, 0]),
        ([], [0.0], [0, 0, 0, 0]),
        ([], [0.03, 0.0], [0, 0, 0, 0]),
        ([], [0.03, 0.03, 0.0], [0, 0, 0, 1, 0]),
        ([1, 1, 1, -1], [0.03], [0, 0, 0, 1, 0, 0, 0]),
        ([1, 1, 1, -3], [0.03], [0, 0, 0, 1, 1, 0, 0, 0]),
    ],
)
def test_moveit_knows_what_is_held_while_it_is_carried(script, widths, hung):
    assert hanging(script, widths)[1] == hung


def test_what_is_held_hangs_on_the_link_where_it_is_seen():
    offset = (0.0, 0.0, 0.163, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    _, _, _, hung, _ = hanging(tcp_offset=offset, clear_m=0.2)
    (held,) = hung[3]
    assert (held.link_name, held.object.header.frame_id) == ("tool0", "tool0")
    assert held.touch_links == ["tool0", *TOUCH]
    at, q = held.object.pose.position, held.object.pose.orientation
    T_link_box = make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([at.x, at.y, at.z]))
    T_world_link = POSE @ make_transform(GRASP.rotation, AT) @ invert(parameters(tcp_offset=offset).T_link_tcp)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, 8).T * held.object.primitives[0].dimensions
    low, high = (f(apply(T_world_link @ T_link_box, corners), axis=0) for f in (np.min, np.max))
    cloud = apply(POSE, deproject(FRAME.depth, FRAME.camera).reshape(-1, 3))
    block = cloud[(cloud[:, 2] > cloud[:, 2].min() + 0.02) & (cloud[:, 0] < 0)]
    assert (block[:, 1] >= low[1] - 1e-6).all()
    assert (block[:, 1] <= high[1] + 1e-6).all(), "as long as the red block"
    assert low[2] == pytest.approx(cloud[:, 2].min(), abs=1e-3), "down to the table"
    assert high[0] < 0, "and not to the blue one"


def test_no_cube_is_where_what_is_held_begins_its_way():
    """A start in collision would be a fault; here a wall stands so near that the lifted thing would be in its cubes."""
    depth = FRAME.depth.copy()
    depth[:, 10:16] = 0.4  # as high as the arm lifts
    wall = replace(FRAME, depth=depth)
    told = parameters(touch_links=TOUCH, obstacle_m=0.02, clear_m=0.05, lift_m=0.3)
    cubes = []
    for links in ((), TOUCH):
        motions = FakeMotions()
        robot_of(replace(told, touch_links=links), motions, FakeGripper(told)).execute(GRASP, wall)
        diff = motions.goals[3].planning_options.planning_scene_diff
        cubes.append(len(diff.world.collision_objects[0].primitives))
    assert cubes[1] < cubes[0]


def test_a_scene_that_is_not_taken_is_a_fault_and_an_old_one_is_taken_off_first():
    with pytest.raises(RobotFault, match="does not take what is held into its scene"):
        run(scene=FakeScene(answers=False), touch_links=TOUCH)
    scene = FakeScene()
    scene.attached["thinkgrasp_held"] = "left by an action that was cancelled"  # type: ignore[assignment]
    motions = FakeMotions(before=lambda n: seen.append(len(scene.attached)))
    seen: list[int] = []
    told = parameters(touch_links=TOUCH)
    assert robot_of(told, motions, FakeGripper(told), scene=scene).execute(GRASP, FRAME).success
    assert seen == [0, 0, 0, 1, 0]
    scene = FakeScene()
    run(scene=scene)
    assert scene.asked == 0, "without touch_links nothing could be held without a collision"


def test_what_is_held_when_cancelled_stays_held():
    done, scene = [], FakeScene()
    told = parameters(touch_links=TOUCH)
    robot = robot_of(told, FakeMotions(before=done.append), FakeGripper(told), lambda: len(done) > 3, scene)
    assert robot.execute(GRASP, FRAME) == Outcome(False, "preempted")
    assert list(scene.attached) == ["thinkgrasp_held"]


def test_the_way_home():
    told = parameters()
    motions = FakeMotions()
    robot_of(told, motions, FakeGripper(told)).go_home()
    assert [joints(goal) for goal in motions.goals] == [0.0]
    robot_of(told, motions, FakeGripper(told), lambda: True).go_home()
    assert len(motions.goals) == 1, "cancelled"
    with pytest.raises(RobotFault, match="could not go home"):
        robot_of(told, FakeMotions([-1]), FakeGripper(told)).go_home()


def test_a_cancel_while_the_gripper_closes():
    told = parameters()
    motions, gripper = FakeMotions(), FakeGripper(told)
    robot = robot_of(told, motions, gripper, lambda: len(gripper.goals) == 2)
    assert robot.execute(GRASP, FRAME) == Outcome(False, "preempted")
    assert len(motions.goals) == 2


def test_preemption_by_someone_else_ends_everything():
    """The loop would go on with the next grasp, from wherever the other one left the arm."""
    with pytest.raises(RobotFault, match="another client of MoveIt took the arm over"):
        run([1, 1, -7])


@pytest.mark.parametrize("code", [-4, -10, -25, -30])
def test_faults_are_raised(code):
    with pytest.raises(RobotFault, match=rf"\({code}\)"):
        run([1, code])


def test_a_parameter_that_does_not_fit_is_named():
    with pytest.raises(ConfigError, match=r"INVALID_GROUP_NAME .*check the parameter group"):
        run([-15])


@pytest.mark.parametrize(
    ("script", "what"),
    [([1, -1, -1], "back off"), ([1, -1, 1, -1], "go home"), ([-3, -1], "go home"), ([1, 1, -1, 1, -1], "back off")],
)
def test_an_arm_that_cannot_get_out_of_the_way_is_a_fault(script, what):
    with pytest.raises(RobotFault, match=f"could not {what} .*stands where it stopped"):
        run(script)
    with pytest.raises(RobotFault, match="could not put down what it holds"):
        run([1, 1, 1, -1, -1])
    with pytest.raises(RobotFault, match="could not carry back what it holds"):
        run([1, 1, 1, -3, -1])


def test_bad_input():
    with pytest.raises(InputError, match="T_world_camera is missing"):
        run(frame=table_frame())
    with pytest.raises(ConfigError, match="joint_names, home_joints and place_joints"):
        run(joint_names=(), home_joints=(), place_joints=())
    told = parameters()
    robot = robot_of(told, FakeMotions(), FakeGripper(told))
    with pytest.raises(InputError, match="must be a finite"):
        robot.execute(replace(GRASP, position=np.array([np.nan, 0, 0.5])), FRAME)
