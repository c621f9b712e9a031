"""Only a clear yes is a yes."""

from __future__ import annotations

import io
import os

import pytest
from fakes.lab import ScriptedPerson, make_cell
from fakes.stages import table_frame
from fakes.table_loop import POSE

from thinkgrasp.errors import InputError
from thinkgrasp.lab.guarded import GuardedRobot
from thinkgrasp.lab.journal import Journal
from thinkgrasp.lab.person import Absent, AtTheKeyboard, Motion
from thinkgrasp.testing import check_robot
from thinkgrasp.types import Grasp, Outcome

MOTION = Motion("straight in", "2.0 s")


@pytest.mark.parametrize(
    ("typed", "answer"),
    [
        ("y\n", "yes"),
        ("YES \n", "yes"),
        ("n\n", "no"),
        ("\n", "no"),
        ("yep\n", "no"),
        ("ja\n", "no"),
        ("1\n", "no"),
        ("s\n", "stop"),
        ("stop\n", "stop"),
        ("q\n", "stop"),
        ("", "stop"),
    ],
)
def test_answers(typed, answer):
    out = io.StringIO()
    assert AtTheKeyboard(io.StringIO(typed), out).allows(MOTION) == answer
    assert "MOVE straight in: 2.0 s. Go?" in out.getvalue()


class Gone(io.StringIO):
    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error = error

    def readline(self, size: int = -1, /) -> str:
        raise self.error


@pytest.mark.parametrize(
    ("error", "answer"),
    [
        (ValueError("I/O operation on closed file"), "stop"),
        (OSError(5, "Input/output error"), "stop"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "no"),
    ],
)
def test_a_keyboard_that_is_gone_or_babbles_is_no_yes(error, answer):
    out = io.StringIO()
    assert AtTheKeyboard(Gone(error), out).allows(MOTION) == answer
    assert ("input has ended" in out.getvalue()) == (answer == "stop")


def test_a_program_without_an_input_is_stopped(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    assert AtTheKeyboard(questions=io.StringIO()).allows(MOTION) == "stop"
    assert AtTheKeyboard(questions=io.StringIO()).confirms("Release it?") is False


def test_what_was_typed_before_the_question_is_no_answer():
    """Somebody hits "y" twice: the second one must not let the next motion go."""
    pytest.importorskip("termios", reason="needs a POSIX terminal")
    master, slave = os.openpty()

    class Screen(io.StringIO):
        def write(self, text: str) -> int:
            if "Go?" in text:
                os.write(master, b"n\n")
            return super().write(text)

    with os.fdopen(master, "wb", buffering=0), os.fdopen(slave, "r") as keyboard:
        os.write(master, b"y\ny\ny\n")
        assert AtTheKeyboard(keyboard, Screen()).allows(MOTION) == "no"


@pytest.mark.parametrize(("typed", "answer"), [("y\n", True), ("n\n", False), ("\n", False), ("", False)])
def test_questions(typed, answer):
    assert AtTheKeyboard(io.StringIO(typed), io.StringIO()).confirms("Release it?") is answer


def test_nobody_lets_motions_go_ahead_and_releases_nothing():
    out = io.StringIO()
    assert Absent(out).allows(MOTION) == "yes"
    assert Absent(out).confirms("Release it?") is False
    assert "MOVE straight in" in out.getvalue()


def test_the_log_is_on_the_disk_at_once(tmp_path):
    path = tmp_path / "robot.jsonl"
    journal = Journal(path)
    journal.note("asked", name="straight in", answer="no")
    journal.note("outcome", reason="refused_by_person")
    lines = path.read_text().splitlines()
    assert len(lines) == 2
    assert '"answer": "no"' in lines[0]
    with pytest.raises(InputError, match=r"robot's log .* cannot be written"):
        Journal(tmp_path / "none" / "robot.jsonl")


# -- robots that do not ask by themselves -----------------------------------------------------------------------------


class Obedient:
    def __init__(self) -> None:
        self.grasps: list[Grasp] = []

    def execute(self, grasp, frame):
        self.grasps.append(grasp)
        return Outcome(True, "held")


def grasp(z: float = 0.58, width: float = 0.05) -> Grasp:
    import numpy as np

    return Grasp(np.eye(3), np.array([0.0, 0.0, z]), width, 0.9)


FRAME = table_frame(T_world_camera=POSE)


def guarded(robot: Obedient, person: ScriptedPerson, **settings) -> GuardedRobot:
    return GuardedRobot(robot, person=person, journal=Journal(), **settings)


def test_any_robot_is_asked_for():
    robot, person = Obedient(), ScriptedPerson(["yes", "no", "stop"])
    guard = guarded(robot, person)
    assert guard.execute(grasp(), FRAME) == Outcome(True, "held")
    assert guard.execute(grasp(), FRAME) == Outcome(False, "refused_by_person")
    assert guard.halted is None
    assert guard.execute(grasp(), FRAME) == Outcome(False, "stopped_by_person")
    assert guard.halted == "stopped_by_person"
    assert guard.execute(grasp(), FRAME) == Outcome(False, "stopped_by_person")
    assert len(robot.grasps) == 1


def test_any_robot_is_spared_what_the_rules_refuse():
    robot = Obedient()
    guard = guarded(robot, ScriptedPerson(), cell=make_cell())
    assert guard.execute(grasp(z=float("nan")), FRAME) == Outcome(False, "invalid_pose")
    assert guard.execute(grasp(z=9.0), FRAME) == Outcome(False, "outside_grasping_area")
    assert robot.grasps == []


def test_a_dry_run_of_any_robot_moves_nothing():
    robot, person = Obedient(), ScriptedPerson()
    assert guarded(robot, person, dry_run=True).execute(grasp(), FRAME) == Outcome(False, "dry_run")
    assert robot.grasps == []
    assert "would move" in person.told[0]


def test_a_robot_that_is_halted_by_itself_is_halted():
    robot = Obedient()
    robot.halted = "protective_stop"  # type: ignore[attr-defined]
    assert guarded(robot, ScriptedPerson()).halted == "protective_stop"
    assert guarded(robot, ScriptedPerson()).execute(grasp(), FRAME) == Outcome(False, "protective_stop")
    assert robot.grasps == []


def test_a_guarded_robot_keeps_the_contract():
    check_robot(guarded(Obedient(), ScriptedPerson()))
