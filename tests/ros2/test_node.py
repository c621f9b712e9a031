"""The node's glue, driven with stand-ins for the ROS modules that know only the calls it makes: not a test of ROS."""

from __future__ import annotations

import sys
import threading
from importlib import import_module
from types import ModuleType, SimpleNamespace

import pytest
from fakes.ros import Strict, camera_info, image, parameters
from fakes.stages import table_frame
from thinkgrasp_ros.interface import RobotFault, TransformUnavailable


class Future:
    def __init__(self) -> None:
        self._callbacks: list = []
        self._done, self._result = False, None

    def set_result(self, value) -> None:
        self._done, self._result = True, value
        for call in self._callbacks:
            call(self)

    def add_done_callback(self, call) -> None:
        call(self) if self._done else self._callbacks.append(call)

    def result(self):
        return self._result


class Handle:
    def __init__(self, server: ScriptedServer) -> None:
        self.accepted, self.server, self.future = server.accepts, server, Future()

    def get_result_async(self) -> Future:
        if self.server.result is not None:
            self.future.set_result(self.server.result)
        return self.future

    def cancel_goal_async(self) -> None:
        self.server.cancels += 1
        if self.server.stops:
            self.future.set_result(self.server.cancelled)


class ScriptedServer:
    """An action server as an ActionClient sees it; without a result it works until it is cancelled."""

    there = accepts = stops = answers = True

    def __init__(self) -> None:
        self.result = self.cancelled = None
        self.cancels, self.goals, self.asked = 0, [], Future()


class SceneServer:
    """A service as its client sees it."""

    there, answer = True, SimpleNamespace(success=True)

    def __init__(self) -> None:
        self.requests: list = []

    def call(self, request) -> Future:
        self.requests.append(request)
        future = Future()
        if self.answer is not None:
            future.set_result(self.answer)
        return future


class Node:
    def __init__(self, name: str) -> None:
        self.name, self.parameters, self.services = name, {}, {}
        self.logged: list[str] = []
        self.scene_server = SceneServer()

    def declare_parameter(self, name, value, descriptor):
        assert descriptor.dynamic_typing
        self.parameters[name] = value
        return SimpleNamespace(value=value)

    def get_logger(self):
        return SimpleNamespace(**dict.fromkeys(("info", "warning", "error"), self.logged.append))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_000_000_000))

    def destroy_node(self):
        self.logged.append("destroyed")

    def create_client(self, kind, name, *, callback_group):
        return SimpleNamespace(
            wait_for_service=lambda *, timeout_sec: self.scene_server.there, call_async=self.scene_server.call
        )

    def create_service(self, kind, name, callback, *, callback_group):
        self.services[name] = callback


class Buffer:
    answer: object = None

    def lookup_transform(self, target, source, time, *, timeout):
        assert time.nanoseconds
        assert timeout.seconds == 0.5
        if isinstance(Buffer.answer, Exception):
            raise Buffer.answer
        return SimpleNamespace(transform=Buffer.answer)


class TransformException(Exception):
    pass


@pytest.fixture
def ros(monkeypatch):
    """The stand-ins, and the node's module that was imported over them."""
    server = ScriptedServer()

    class ActionClient:
        def __init__(self, node, kind, name, *, callback_group) -> None:
            self.name = name

        def wait_for_server(self, *, timeout_sec):
            return server.there

        def send_goal_async(self, goal) -> Future:
            server.goals.append(goal)
            server.asked = Future()
            if server.answers:
                server.asked.set_result(Handle(server))
            return server.asked

    class ActionServer:
        def __init__(self, node, kind, name, *, execute_callback, goal_callback, cancel_callback, callback_group):
            node.action = SimpleNamespace(run=execute_callback, accept=goal_callback, cancel=cancel_callback)

    class Subscriber:
        def __init__(self, node, kind, topic, *, qos_profile, callback_group) -> None:
            self.topic = topic

    class Synchroniser:
        def __init__(self, sources, queue, slop) -> None:
            self.topics, self.slop = [s.topic for s in sources], slop

        def registerCallback(self, call):  # noqa: N802
            self.feed = call

    def maker(name):
        return type(name.rpartition("/")[2], (), {"__new__": lambda cls: Strict(name)})

    def action(name, package="thinkgrasp_interfaces"):
        parts = {p: maker(f"{package}/action/{name}_{p}") for p in ("Goal", "Result", "Feedback")}
        return SimpleNamespace(**parts)

    calls: list = []
    values = {
        "rclpy": {"init": lambda **kw: calls.append(kw), "try_shutdown": lambda: calls.append("shutdown")},
        "rclpy.logging": {"get_logger": lambda name: None},
        "rclpy.action": {
            "ActionClient": ActionClient,
            "ActionServer": ActionServer,
            "CancelResponse": SimpleNamespace(ACCEPT="accept"),
            "GoalResponse": SimpleNamespace(ACCEPT="accept", REJECT="reject"),
        },
        "rclpy.callback_groups": {"MutuallyExclusiveCallbackGroup": object, "ReentrantCallbackGroup": object},
        "rclpy.duration": {"Duration": lambda *, seconds: SimpleNamespace(seconds=seconds)},
        "rclpy.executors": {"ExternalShutdownException": RuntimeError, "MultiThreadedExecutor": object},
        "rclpy.node": {"Node": Node},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="no handlers")},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "rclpy.time": {"Time": lambda *, nanoseconds: SimpleNamespace(nanoseconds=nanoseconds)},
        "rcl_interfaces.msg": {"ParameterDescriptor": lambda *, dynamic_typing: SimpleNamespace(dynamic_typing=True)},
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformException": TransformException,
            "TransformListener": lambda buffer, node: None,
        },
        "message_filters": {"ApproximateTimeSynchronizer": Synchroniser, "Subscriber": Subscriber},
        "control_msgs.action": {"GripperCommand": action("GripperCommand", "control_msgs")},
        "moveit_msgs.action": {"MoveGroup": action("MoveGroup", "moveit_msgs")},
        "moveit_msgs.srv": {"ApplyPlanningScene": SimpleNamespace(Request=SimpleNamespace)},
        "moveit_msgs.msg": {"Constraints": maker("moveit_msgs/msg/Constraints")},
        "sensor_msgs.msg": {"CameraInfo": "CameraInfo", "Image": "Image"},
        "thinkgrasp_interfaces.action": {"ClearAndGrasp": action("ClearAndGrasp")},
        "thinkgrasp_interfaces.srv": {"FindGrasp": "FindGrasp"},
    }
    for name, held in values.items():
        for part in (name.split(".")[0], name):
            if part not in sys.modules or not hasattr(sys.modules[part], "__stand_in__"):
                module = ModuleType(part)
                module.__stand_in__ = True  # type: ignore[attr-defined]
                monkeypatch.setitem(sys.modules, part, module)
        for key, value in held.items():
            setattr(sys.modules[name], key, value)
        if "." in name:
            setattr(sys.modules[name.split(".")[0]], name.split(".")[1], sys.modules[name])
    monkeypatch.delitem(sys.modules, "thinkgrasp_ros.node", raising=False)
    module = import_module("thinkgrasp_ros.node")
    monkeypatch.setattr(module, "_CONNECT_S", 0.1)
    yield SimpleNamespace(module=module, server=server, calls=calls)
    sys.modules.pop("thinkgrasp_ros.node", None)


def never() -> bool:
    return False


def motions(ros, **changes):
    return ros.module.RosMotions(Node("n"), parameters(**({"motion_timeout_s": 0.2, "planning_time_s": 0.1} | changes)))


def moved(code: int, points: int = 0):
    planned = SimpleNamespace(joint_trajectory=SimpleNamespace(points=[0] * points))
    return SimpleNamespace(
        result=SimpleNamespace(error_code=SimpleNamespace(val=code), planned_trajectory=planned), status=4
    )


def test_messages_are_found_by_their_names(ros):
    messages = ros.module.RosMessages()
    assert messages.new("moveit_msgs/msg/Constraints")._name == "moveit_msgs/msg/Constraints"
    assert messages.new("moveit_msgs/action/MoveGroup_Goal")._name == "moveit_msgs/action/MoveGroup_Goal"
    assert messages.new("thinkgrasp_interfaces/action/ClearAndGrasp_Feedback").step == 0


def test_a_motion_returns_moveits_code(ros):
    ros.server.result = moved(-12)
    assert motions(ros).move("goal", never) == -12
    assert (ros.server.goals, ros.server.cancels) == (["goal"], 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [({"there": False}, "no action server /move_action"), ({"accepts": False}, "rejects the goal")],
)
def test_a_server_that_does_not_play_along_is_a_fault(ros, change, said):
    for key, value in change.items():
        setattr(ros.server, key, value)
    with pytest.raises(RobotFault, match=said):
        motions(ros).move("goal", never)


@pytest.mark.parametrize(("code", "points", "meant"), [(-6, 0, -6), (-6, 7, -4), (1, 7, 1), (-3, 7, -3)])
def test_a_controller_that_takes_too_long_is_no_planner_that_does(ros, code, points, meant):
    """The loop goes on after a planner's TIMED_OUT; an arm that stalls on its way somebody has to look at."""
    ros.server.result = moved(code, points)
    assert motions(ros).move("goal", never) == meant


def test_a_goal_that_is_accepted_too_late_is_cancelled(ros):
    ros.server.answers = False
    with pytest.raises(RobotFault, match="did not answer in"):
        motions(ros).move("goal", never)
    assert ros.server.cancels == 0
    ros.server.asked.set_result(Handle(ros.server))
    assert ros.server.cancels == 1


def test_a_planner_has_its_time_to_come_to_an_end_after_a_cancel(ros):
    """move_group answers a cancel only when the planner is through, and RRT* takes all its time."""
    ros.server.stops = False
    asked: list[float] = []
    client = motions(ros, planning_time_s=0.5)
    real = ros.module._wait

    def waiting(future, timeout_s, cancelled):
        asked.append(timeout_s)
        if len(asked) == 3:
            future.set_result(moved(-7))
        return real(future, timeout_s, cancelled)

    ros.module._wait = waiting
    assert client.move("goal", lambda: True) == -7
    assert asked[2] == pytest.approx(0.6)


def test_a_motion_that_takes_too_long_is_cancelled_and_a_fault(ros):
    ros.server.cancelled = moved(-7)
    with pytest.raises(RobotFault, match=r"was not done in 0\.2 s; it was cancelled"):
        motions(ros).move("goal", never)
    assert ros.server.cancels == 1


def test_a_cancelled_motion_returns_what_moveit_says_of_it(ros):
    ros.server.cancelled = moved(-7)
    stop = threading.Event()
    threading.Timer(0.05, stop.set).start()
    assert motions(ros, motion_timeout_s=5.0).move("goal", stop.is_set) == -7
    assert ros.server.cancels == 1


def test_a_motion_that_does_not_stop_is_a_fault(ros):
    ros.server.stops = False
    with pytest.raises(RobotFault, match="does not stop although it was cancelled"):
        motions(ros).move("goal", lambda: True)


def test_the_planning_scene(ros):
    node = Node("n")
    scene = ros.module.RosScene(node, parameters())
    assert scene.apply("difference") is True
    assert node.scene_server.requests[0].scene == "difference"
    node.scene_server.answer = SimpleNamespace(success=False)
    assert scene.apply("difference") is False
    node.scene_server.answer = None
    with pytest.raises(RobotFault, match=r"/apply_planning_scene \(MoveIt\) did not answer"):
        scene.apply("difference")
    node.scene_server.there = False
    with pytest.raises(RobotFault, match="no service /apply_planning_scene"):
        scene.apply("difference")


@pytest.mark.parametrize(
    ("status", "stalled", "good"), [(4, False, True), (4, True, True), (6, True, True), (6, False, False)]
)
def test_a_gripper_that_stalls_has_done_its_work(ros, status, stalled, good):
    result = SimpleNamespace(position=0.4, stalled=stalled, reached_goal=False)
    ros.server.result = SimpleNamespace(result=result, status=status)
    gripper = ros.module.RosGripper(Node("n"), parameters())
    if good:
        assert gripper.command("goal", never).position == 0.4
    else:
        with pytest.raises(RobotFault, match="failed with status 6"):
            gripper.command("goal", never)


def test_tf_at_the_images_time(ros):
    transforms = ros.module.RosTransforms(Node("n"), 0.5)
    Buffer.answer = Strict("geometry_msgs/msg/Transform")
    Buffer.answer.rotation.w = 1.0
    assert transforms.lookup("world", "camera", 7).shape == (4, 4)
    Buffer.answer = TransformException("extrapolation into the future")
    with pytest.raises(TransformUnavailable, match=r"pose of 'camera' in 'world' at the images' time .*extrapolation"):
        transforms.lookup("world", "camera", 7)


def test_the_node_offers_its_service_and_its_action(ros):
    node = ros.module.ThinkGraspNode()
    assert node.parameters["planner"] == "RRTstar"
    assert node.parameters["camera.color_topic"] == "/camera/color/image_raw"
    assert list(node.services) == ["~/find_grasp"]
    (synchroniser,) = node._synchronisers
    assert synchroniser.topics == [
        "/camera/color/image_raw",
        "/camera/aligned_depth_to_color/image_raw",
        "/camera/color/camera_info",
    ]
    assert synchroniser.slop == 0.05
    frame = table_frame()
    ns = 5_000_000_000
    depth = (frame.depth * 1000).astype("uint16")
    synchroniser.feed(image(frame.color, "rgb8", ns), image(depth, "16UC1", ns), camera_info(frame.camera, ns))
    Buffer.answer = Strict("geometry_msgs/msg/Transform")
    request = Strict("thinkgrasp_interfaces/srv/FindGrasp_Request")
    request.instruction = ""
    response = node.services["~/find_grasp"](request, Strict("thinkgrasp_interfaces/srv/FindGrasp_Response"))
    assert response.status == "error"
    assert "no rigid transform" in response.message, "the images came through, the pose did not"


def goal_handle(called: list[str], *, cancelled: bool = False):
    return SimpleNamespace(
        request=Strict("thinkgrasp_interfaces/action/ClearAndGrasp_Goal"),
        is_cancel_requested=cancelled,
        publish_feedback=lambda m: None,
        **{name: (lambda name=name: called.append(name)) for name in ("abort", "canceled", "succeed")},
    )


@pytest.mark.parametrize(
    ("end", "cancelled", "stopping", "ends"),
    [
        ("error", False, False, "abort"),
        ("error", True, False, "abort"),
        ("stopped", True, False, "canceled"),
        ("stopped", False, True, "abort"),
        ("no_grasp", False, False, "succeed"),
        ("goal_delivered", False, False, "succeed"),
    ],
)
def test_a_goal_ends_in_the_right_state(ros, end, cancelled, stopping, ends):
    """A fault is not hidden by a cancel: "does not stop although it was cancelled" is one."""
    node = ros.module.ThinkGraspNode()
    called: list[str] = []
    handle = goal_handle(called, cancelled=cancelled)
    assert node.action.accept(handle.request) == "accept"
    assert node.action.cancel(handle) == "accept"

    def serve(goal, result, *, cancelled, publish):
        if stopping:
            node.stop()
        assert cancelled() == (handle.is_cancel_requested or stopping)
        result.end = end

    node._server.clear_and_grasp = serve
    assert (node.action.run(handle).end, called) == (end, [ends])


def test_a_goal_is_rejected_while_another_is_served_or_the_node_stops(ros):
    node = ros.module.ThinkGraspNode()
    called: list[str] = []
    handle = goal_handle(called)
    result = node.action.run(handle)
    assert (result.end, called) == ("error", ["abort"]), "no joints were named"
    node._server._at_work.acquire()
    assert node.action.accept(handle.request) == "reject"
    node._server._at_work.release()
    node.stop()
    assert node.action.accept(handle.request) == "reject"


def test_a_fault_of_ours_is_an_answer_and_the_node_goes_on(ros):
    node = ros.module.ThinkGraspNode()

    def broken(*args, **kw):
        raise ZeroDivisionError("a bug")

    node._server.find_grasp = node._server.clear_and_grasp = broken
    request = Strict("thinkgrasp_interfaces/srv/FindGrasp_Request")
    response = node.services["~/find_grasp"](request, Strict("thinkgrasp_interfaces/srv/FindGrasp_Response"))
    assert (response.status, response.message[:14]) == ("error", "internal error")
    called: list[str] = []
    result = node.action.run(goal_handle(called))
    assert (result.end, result.message[:14], called) == ("error", "internal error", ["abort"])
    assert sum("ZeroDivisionError: a bug" in line for line in node.logged) == 2


@pytest.mark.parametrize("stops", [True, False])
def test_a_signal_stops_the_motion_before_the_node_ends(ros, monkeypatch, stops):
    """rclpy's own handlers would end all communication at once, and the arm would move on without it."""
    handlers: dict[int, object] = {}
    nodes: list = []
    monkeypatch.setattr(ros.module.signal, "signal", lambda number, call: handlers.update({number: call}))
    monkeypatch.setattr(ros.module, "_STOP_S", 0.05)
    spins: list[bool] = []

    class Executor:
        def __init__(self, num_threads):
            assert num_threads >= 4

        def add_node(self, node):
            nodes.append(node)
            node._server._at_work.acquire()

        def spin_once(self, timeout_sec):
            spins.append(nodes[0].is_stopping)
            if len(spins) == 2:
                handlers[ros.module.signal.SIGINT]()  # type: ignore[operator]
            if len(spins) == 5 and stops:
                nodes[0]._server._at_work.release()

    monkeypatch.setattr(ros.module, "MultiThreadedExecutor", Executor)
    ros.module.main()
    assert set(handlers) == {ros.module.signal.SIGINT, ros.module.signal.SIGTERM}
    assert spins[:3] == [False, False, True]
    assert ros.calls == [{"signal_handler_options": "no handlers"}, "shutdown"]
    assert nodes[0].logged[-1] == "destroyed"
    assert any("did not stop" in line for line in nodes[0].logged) == (not stops)
    assert (len(spins) == 5) == stops
