"""The gripper's driver against a server that speaks its protocol over a real socket, and speaks it badly."""

from __future__ import annotations

import time

import pytest
from fakes.robotiq_server import FakeGripperServer, Fingers, gripper_server

from thinkgrasp.errors import ConfigError
from thinkgrasp.robots import robotiq
from thinkgrasp.robots.robotiq import Counts, GripperError, GripperSilent, RobotiqGripper, Seen


@pytest.fixture
def connect():
    grippers: list[RobotiqGripper] = []

    def make(server: FakeGripperServer, **settings) -> RobotiqGripper:
        grippers.append(RobotiqGripper("127.0.0.1", server.port, timeout_s=0.15, sleep=lambda s: None, **settings))
        return grippers[-1]

    yield make
    for gripper in grippers:
        gripper.close()


@pytest.fixture
def server():
    with gripper_server() as running:
        yield running


# -- counts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "opening", "count"),
    [
        ("robotiq_2f85", 0.085, 3),
        ("robotiq_2f85", 0.0, 228),
        ("robotiq_2f85", 0.0425, 116),
        ("robotiq_2f85", 0.2, 3),
        ("robotiq_2f85", -0.1, 228),
        ("robotiq_2f140", 0.140, 3),
        ("robotiq_2f140", 0.070, 116),
    ],
)
def test_openings_and_counts(model, opening, count):
    assert Counts(model).position(opening) == count


def test_every_count_comes_back():
    counts = Counts()
    assert [counts.position(counts.opening(c)) for c in range(3, 229)] == list(range(3, 229))
    assert (counts.opening(0), counts.opening(255)) == (0.085, 0.0)


@pytest.mark.parametrize(
    ("model", "force", "speed", "expected"),
    [
        ("robotiq_2f85", 20.0, 0.02, (0, 0)),
        ("robotiq_2f85", 235.0, 0.15, (255, 255)),
        ("robotiq_2f85", 1e6, 9.0, (255, 255)),
        ("robotiq_2f85", 0.0, 0.0, (0, 0)),
        ("robotiq_2f140", 10.0, 0.03, (0, 0)),
        ("robotiq_2f140", 125.0, 0.25, (255, 255)),
    ],
)
def test_forces_and_speeds(model, force, speed, expected):
    counts = Counts(model)
    assert (counts.force(force), counts.speed(speed)) == expected


@pytest.mark.parametrize(
    "make",
    [
        lambda: Counts("schunk"),
        lambda: Counts(open_count=228, closed_count=3),
        lambda: Counts(closed_count=300),
        lambda: Counts().position(float("nan")),
        lambda: Counts().force(float("inf")),
    ],
)
def test_what_cannot_be_counted_is_refused(make):
    with pytest.raises(ConfigError, match="gripper"):
        make()


# -- what it does ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ending", "pieces"), [(b"\n", 1), (b"", 1), (b"\r\n", 1), (b"\n", 4)])
def test_moves_whatever_the_line_ends_are(connect, server, ending, pieces):
    server.ending, server.pieces = ending, pieces
    state = connect(server).move(0.04)
    assert state.seen is Seen.AT_POSITION
    assert state.opening_m == pytest.approx(0.04, abs=2e-4)
    assert not state.has_object


def test_force_and_speed_are_sent_with_the_position(connect, server):
    connect(server, force_n=127.5, speed_m_s=0.085).move(0.085)
    assert "SET POS 3 SPE 128 FOR 128 GTO 1" in server.requests


def test_grips_a_thing_and_notices_that_it_is_gone(connect):
    fingers = Fingers(thing=120)
    with gripper_server(fingers) as server:
        gripper = connect(server)
        gripped = gripper.grip()
        assert gripped.has_object
        assert gripped.opening_m == pytest.approx(Counts().opening(120))
        assert gripper.still_holds(gripped)
        fingers.thing, fingers.target = None, 255
        fingers.at = 228
        assert not gripper.still_holds(gripped)


def test_what_gives_way_is_not_held_any_more(connect):
    fingers = Fingers(thing=120)
    with gripper_server(fingers) as server:
        gripper = connect(server)
        gripped = gripper.grip()
        fingers.thing = fingers.at = 150
        assert not gripper.still_holds(gripped)


def test_fingers_that_meet_hold_nothing(connect, server):
    state = connect(server).grip()
    assert (state.has_object, state.opening_m) == (False, 0.0)


def test_activates_only_where_it_is_not(connect):
    with gripper_server(active=False) as server:
        gripper = connect(server)
        with pytest.raises(GripperError, match="not activated"):
            gripper.move(0.02)
        gripper.activate()
        assert gripper.is_active()
        assert [r for r in server.requests if r.startswith("SET ACT")] == ["SET ACT 0 ATR 0", "SET ACT 1"]
        server.requests.clear()
        gripper.activate()
        assert not any(r.startswith("SET") for r in server.requests)


def test_an_activation_asks_for_no_position(connect):
    """GTO would send the fingers to wherever POS was left by whoever used the gripper before."""
    with gripper_server(Fingers(position=3), active=False) as server:
        server.registers["POS"] = 255
        connect(server).activate()
        assert server.registers["GTO"] == 0


def test_an_interrupted_activation_is_taken_back(connect):
    with gripper_server(active=False) as server:
        gripper = connect(server)

        def interrupt(seconds: float) -> None:
            if server.registers["ACT"]:
                raise KeyboardInterrupt

        gripper._sleep = interrupt
        with pytest.raises(KeyboardInterrupt):
            gripper.activate()
        assert server.registers["ACT"] == 0


@pytest.mark.parametrize("goal", [0.0, 0.03])
def test_a_word_that_comes_late_is_not_believed(connect, server, goal):
    """OBJ may say for a while that the fingers are where they were told to be the time before."""
    server.late = 4
    assert connect(server).move(goal).opening_m == pytest.approx(goal, abs=3e-4)


def test_an_ack_without_line_end_is_not_waited_for(connect, server):
    """The gripper's own program compares with "ack" alone, while registers come as lines."""
    server.ack_ending = b""
    gripper = connect(server)
    gripper.get("POS")
    gripper.move(0.03)
    assert gripper._end_lines == {robotiq._REPLY}


def test_pads_that_meet_hold_nothing_whatever_the_gripper_says(connect, server):
    server.spoil = lambda request, reply: b"OBJ 2" if reply[:3] == b"OBJ" and server.fingers.seen else reply
    assert not connect(server).grip().has_object


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_fingers_stop_when_they_are_not_waited_for_any_more(connect, server, error):
    gripper = connect(server)

    def interrupted(seconds: float) -> None:
        raise error

    gripper._sleep = interrupted
    with pytest.raises(error):
        gripper.grip()
    assert server.registers["GTO"] == 0
    at = server.fingers.position
    assert gripper.get("POS") == at < 228


def test_halt_never_raises(connect, server):
    gripper = connect(server)
    gripper.halt()
    assert server.registers["GTO"] == 0
    server.spoil = lambda request, reply: None
    gripper.halt()


# -- what goes wrong -------------------------------------------------------------------------------------------------


def test_nobody_listens():
    with gripper_server() as server:
        port = server.port
    with pytest.raises(GripperSilent, match=r"nothing answers .* is the gripper's URCap installed"):
        RobotiqGripper("127.0.0.1", port, timeout_s=0.15)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda request, reply: b"", "said nothing for 0.15 s"),
        (lambda request, reply: None, "closed by the other side"),
        (lambda request, reply: b"\xff\x00\x13", "answered b'"),
        (lambda request, reply: b"nack", "answered b'nack"),
        (lambda request, reply: b"STA ?" if reply[:3] == b"STA" else reply, "is the gripper connected"),
        (lambda request, reply: b"XYZ 3" if request.startswith("GET") else reply, "was asked for"),
        (lambda request, reply: b"OBJ 7" if reply[:3] == b"OBJ" else reply, "OBJ 7, which means nothing"),
        (lambda request, reply: b"POS 999" if reply[:3] == b"POS" else reply, "POS 999, allowed are"),
        (lambda request, reply: b"x" * 5000, "answered b'xxx"),
        (lambda request, reply: b"" if request.startswith("SET") else reply, "said nothing"),
        (lambda request, reply: b"PRE 1" if reply[:3] == b"PRE" else reply, "was not told to go to"),
    ],
    ids=["silent", "closed", "binary", "nack", "unknown", "other", "OBJ", "POS", "flood", "no ack", "not echoed"],
)
def test_what_makes_no_sense_is_silence(connect, server, spoil, message):
    gripper = connect(server)
    server.spoil = spoil
    with pytest.raises(GripperSilent, match=message) as caught:
        gripper._go(100, 0.3)
    assert caught.value.reason == "gripper_silent"


def test_falls_silent_while_it_moves(connect, server):
    gripper = connect(server)
    seen: list[str] = []

    def spoil(request: str, reply: bytes) -> bytes:
        seen.append(request)
        return b"" if seen.count("GET OBJ") > 1 else reply

    server.spoil = spoil
    with pytest.raises(GripperSilent, match="said nothing"):
        gripper.move(0.01)


def test_fingers_that_never_come_to_rest(connect, server):
    server.spoil = lambda request, reply: b"OBJ 0" if reply[:3] == b"OBJ" else reply
    with pytest.raises(GripperSilent, match="was not at rest within"):
        connect(server).move(0.01, timeout_s=0.2)


@pytest.mark.parametrize(("fault", "word"), [(9, "no communication"), (13, "activation failed"), (14, "overcurrent")])
def test_faults_have_names(connect, server, fault, word):
    server.registers["FLT"] = fault
    with pytest.raises(GripperError, match=word) as caught:
        connect(server).move(0.01)
    assert caught.value.reason == "gripper_fault"


def test_a_late_reply_is_not_taken_for_the_next(connect, server):
    gripper = connect(server)
    server.delay_s = 0.25
    with pytest.raises(GripperSilent):
        gripper.get("POS")
    server.delay_s = 0.0
    time.sleep(0.2)
    assert gripper.get("STA") == 3


def test_an_activation_that_never_ends(connect):
    with gripper_server(active=False) as server:
        server.spoil = lambda request, reply: b"STA 1" if reply[:3] == b"STA" else reply
        with pytest.raises(GripperSilent, match=r"was not reset within 0\.2 s"):
            connect(server).activate(timeout_s=0.2)
