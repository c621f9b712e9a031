"""`thinkgrasp run`: the very command that runs on a real robot, on a lab that is the simulator."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import small_pile
from fakes.lab import FakeLab, write_cell

from thinkgrasp.episode import EpisodeModel, read_episode
from thinkgrasp.geometry import make_transform
from thinkgrasp.sim.scenes import PiledScene
from thinkgrasp.sim.world import World

SENTENCE = "give me the mug"


@cache
def _pile() -> PiledScene:
    return small_pile(("pear", "mug"), (1,))


@pytest.fixture
def lab(monkeypatch) -> Iterator[FakeLab]:
    """A pear and a mug on the table of a fake lab."""
    world = World(_pile().spec.objects)
    for index, T in enumerate(_pile().poses):
        world.place(index, T)
    world.settle()
    made = FakeLab(world)
    for name, module in made.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    yield made
    made.close()


@pytest.fixture
def run(cli, lab, tmp_path, monkeypatch) -> Callable[..., tuple[object, Path]]:
    """Run the command with what a person types."""

    def with_answers(typed: str, *args: str, **changes):
        cell = write_cell(tmp_path, lab, **changes)
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        out = tmp_path / "out"
        return cli("run", SENTENCE, "--cell", str(cell), "--out", str(out), *args), out

    return with_answers


def log(out: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (out / "robot.jsonl").read_text().splitlines()]


def test_delivers_the_goal(run, lab):
    """--robot ur --camera realsense, spelt out once; they are the defaults."""
    result, out = run("y\n" * 40, "--robot", "ur", "--camera", "realsense", "--json")
    assert result.code == 0, result.err
    episode = EpisodeModel.model_validate_json(result.out)
    assert (episode.success, episode.end, episode.instruction) == (True, "goal_delivered", SENTENCE)
    assert lab.world.settle()
    assert lab.world.in_bin(1)
    assert not lab.world.in_bin(0)
    assert lab.realsense.stopped, "the camera is given back"
    assert not lab.running, "control is given back"
    recorded = read_episode(out)
    assert recorded.ended is not None
    assert len(recorded.steps) == episode.steps
    for name in ("report.html", "config.json", "robot.jsonl", "now.png", "steps/001/decision.json"):
        assert (out / name).is_file(), name
    events = log(out)
    asked = [e for e in events if e["event"] == "asked"]
    moved = [e for e in events if e["event"] == "moved"]
    assert len(asked) == result.err.count("MOVE ") >= 8
    assert {m["name"] for m in moved} <= {a["name"] for a in asked}, "nothing moved that was not asked for"
    assert events[-1] | {"time": 0} == {"time": 0, "event": "end", "end": "goal_delivered", "halted": None}
    for finding in ("tool", "kinematics", "calibration record", "table", "arm in view"):
        assert f"ok     {finding}" in result.err
    assert "plan: take mug (goal)" in result.err


def test_a_dry_run_plans_shows_and_moves_nothing(run, lab):
    result, out = run("", "--dry-run")
    assert result.code == 0, result.err
    assert "a motion was planned" in result.out
    assert "would move to the bin" in result.err
    assert "dry run: nothing was moved" in result.err
    assert (lab.moved, lab.controlled, lab.gripper.requests) == (0, False, [])
    assert (out / "report.html").is_file()
    assert [e["name"] for e in log(out) if e["event"] == "planned"][-1] == "to the bin"


def test_silence_ends_the_run(run, lab):
    result, out = run("")
    assert result.code == 1
    assert lab.moved == 0
    assert "stopped: whoever watches stopped the episode" in result.out
    assert "stands still: stopped_by_person" in result.out
    assert log(out)[-1]["halted"] == "stopped_by_person"


def test_a_no_asks_for_another_grasp(run, lab):
    result, out = run("n\ns\n")
    assert result.code == 1
    assert [e["reason"] for e in log(out) if e["event"] == "outcome"] == ["refused_by_person", "stopped_by_person"]
    first, second = (read_episode(out).steps[i].decision().grasp for i in (0, 1))
    assert first is not None
    assert second is not None
    assert first.position_m != second.position_m, "what was refused is not offered again"
    assert lab.moved == 0


def test_a_protective_stop_ends_the_run_and_is_recorded(run, lab):
    lab.after = lambda done: lab.protective_stop() if done == 200 else None
    result, out = run("", "--no-confirm")
    assert result.code == 1
    assert lab.unlocked == 0
    assert "the robot stands still (protective stop)" in result.err
    recorded = read_episode(out)
    assert recorded.ended is not None
    assert [o.reason for o in recorded.ended.outcomes if o] == ["protective_stop"]
    assert recorded.ended.end == "stopped"


@pytest.mark.parametrize("where", ["at the question", "in the middle of a motion"])
def test_an_interrupt_from_the_keyboard_is_recorded(run, lab, monkeypatch, where):
    def interrupt(*_: object) -> str:
        raise KeyboardInterrupt

    if where == "at the question":
        monkeypatch.setattr("thinkgrasp.lab.person.AtTheKeyboard.allows", interrupt)
        result, out = run("")
    else:
        lab.after = lambda done: interrupt() if done == 200 else None
        result, out = run("", "--no-confirm")
    assert result.code == 130
    assert "the robot was stopped where it is" in result.err
    assert lab.stops == (where != "at the question")
    assert not lab.running, "control is given back"
    assert log(out)[-1]["event"] == "interrupted"
    ended = read_episode(out).ended
    assert ended is not None
    assert ended.end == "interrupted"
    assert (out / "report.html").is_file()


def test_a_camera_that_was_moved_stops_before_the_first_move(run, lab, tmp_path):
    T = lab.view.T_world_camera
    lab.view = type(lab.view)(lab.view.intrinsics, make_transform(np.eye(3), np.array([0, 0, 0.03])) @ T)
    result, _ = run("y\n" * 40)
    assert result.code == 1
    assert lab.moved == 0
    assert "failed table: the camera sees the table top at z = 3" in result.err


def test_a_frozen_camera_is_an_error_and_what_was_done_is_kept(run, lab):
    """And --no-confirm asks nobody."""
    lab.after = lambda done: setattr(lab.realsense, "same", True)
    result, out = run("", "--no-confirm")
    assert result.code == 2
    assert "the camera is frozen" in result.err.splitlines()[-1]
    events = log(out)
    assert events[-1]["event"] == "failed"
    assert [e["reason"] for e in events if e["event"] == "outcome"] == ["held"]
    recorded = read_episode(out)
    assert [step.line.outcome.reason for step in recorded.steps if step.line.outcome] == ["held"]
    assert recorded.ended is not None


@pytest.mark.parametrize(
    ("args", "changes", "message"),
    [
        (("--speed", "1.5"), {}, "--speed is a share of the cell's limits and must lie in (0, 1], got 1.5"),
        (("--robot", "kuka"), {}, "no robot named 'kuka'; installed: simulated, ur"),
        (("--camera", "webcam"), {}, "no camera named 'webcam'"),
        (("--camera-set", "serial=9"), {}, "no RealSense camera 9 is connected"),
        (("--arm-planner", "A*"), {}, "no arm planner 'A*'"),
        (("--dry-run", "--robot-set", "dry_run=false"), {}, "--robot-set dry_run: that is said by the command's own"),
        (("--robot-set", "person"), {}, "--robot-set takes KEY=VALUE"),
        (("--camera-set", "=9"), {}, "--camera-set takes KEY=VALUE"),
        (("--robot-set", "person=null"), {}, "--robot-set person: that is said by"),
        ((), {"limits.tcp_speed_m_s": 3}, "limits.tcp_speed_m_s: Input should be less than or equal to 1"),
        ((), {"camera.file": "none.json"}, "camera file"),
        ((), {"camera.mount": "hand"}, "lacks T_flange_camera, which a camera that is mounted 'hand' needs"),
        ((), {"camera.settings": {"lens": 5}}, "does not take the settings"),
    ],
)
def test_what_cannot_be_run_is_one_line(run, lab, args, changes, message):
    result, _ = run("y\n" * 40, *args, **changes)
    assert (result.code, result.out) == (2, "")
    assert message in result.err
    assert result.err.splitlines()[-1].startswith("error: ")
    assert lab.moved == 0


def test_the_arm_needs_a_cell(cli, tmp_path, lab):
    result = cli("run", SENTENCE, "--out", str(tmp_path))
    assert result.code == 2
    assert "the robot 'ur' needs --cell FILE" in result.err


def test_a_robot_of_ones_own_is_one_more_name(cli, tmp_path, monkeypatch, lab):
    """A plug-in with execute() only: it is asked for, with frames from files."""
    from importlib.metadata import EntryPoint

    from thinkgrasp import registry
    from thinkgrasp.cameras.saving import save_frame
    from thinkgrasp.testing import sample_frame

    available = registry.available
    mine = EntryPoint("mine", "fakes.own_robot:OwnRobot", "thinkgrasp.robot")
    monkeypatch.setattr(
        registry, "available", lambda kind: {**available(kind), **({"mine": mine} if kind == "robot" else {})}
    )
    color, depth, camera = save_frame(sample_frame(), tmp_path)
    files = [f"--camera-set={k}={v}" for k, v in (("color", color), ("depth", depth), ("camera", camera))]
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    out = tmp_path / "out"
    command = ["run", "the red box", "--robot", "mine", "--robot-set", "reason=missed", "--camera", "files", *files]
    result = cli(*command, "--steps", "1", "--out", str(out))
    assert result.code == 1, result.err
    assert "MOVE to a grasp and on to the bin" in result.err
    assert [e["reason"] for e in log(out) if e["event"] == "outcome"] == ["missed"]


def test_a_camera_on_the_hand_sees_from_where_the_hand_is(run, lab, tmp_path):
    """The same picture, its pose said through the flange at home."""
    from thinkgrasp.geometry import invert

    T = invert(lab.world.flange()) @ lab.view.T_world_camera
    write_cell(tmp_path, lab)
    camera = json.loads((tmp_path / "camera.json").read_text())
    del camera["T_world_camera"], camera["hand_eye"]
    (tmp_path / "hand.json").write_text(json.dumps({**camera, "T_flange_camera": T.tolist()}))
    result, _ = run("", "--dry-run", **{"camera.mount": "hand", "camera.file": "hand.json"})
    assert result.code == 0, result.err
    assert "ok     table" in result.err
