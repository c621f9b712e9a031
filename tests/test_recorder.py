"""The durable record: complete steps at any moment of death, and reading them back."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fakes.stages import fake_pipeline, table_frame
from PIL import Image

from thinkgrasp import recorder as recorder_module
from thinkgrasp.cameras.files import load_frame
from thinkgrasp.episode import (
    EpisodeHeader,
    EpisodeModel,
    OutcomeModel,
    RecordedEpisode,
    episode_to_schema,
    read_episode,
)
from thinkgrasp.errors import InputError
from thinkgrasp.fusion import fuse
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.recorder import EpisodeRecorder
from thinkgrasp.schema import decision_to_schema, mask_from_png
from thinkgrasp.testing import check_recorder
from thinkgrasp.types import Decision, Outcome, Usage
from thinkgrasp.viz.report import write_report

GRIPPER = GRIPPERS["robotiq_2f85"]
HEADER = EpisodeHeader(instruction="the blue block", goal="blue block", preset="offline", seed=3)
USAGE = Usage("gpt-4o", 2400, 160, None, 3, 2.5)
STEP_FILES = {
    "color.png",
    "depth.png",
    "camera.json",
    "decision.json",
    "scene.json",
    "outcome.json",
    "overlay.png",
    "panel.html",
}


@dataclass(frozen=True)
class Step:
    decision: Decision
    outcome: Outcome | None


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    """Missed, held, nothing found."""
    pipeline, frame = fake_pipeline(), table_frame()
    return [
        Step(pipeline.decide(frame, "red"), Outcome(False, "missed")),
        Step(pipeline.decide(frame, "blue"), Outcome(True, "held")),
        Step(pipeline.decide(frame, "green"), None),
    ]


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., EpisodeRecorder]:
    def make(steps: list[Step], folder: Path = tmp_path / "episode") -> EpisodeRecorder:
        recorder = EpisodeRecorder(folder, header=HEADER, gripper=GRIPPER)
        for step in steps:
            recorder.record(step.decision, step.outcome)
        return recorder

    return make


def check_complete(episode: RecordedEpisode) -> None:
    """Every listed step is there with all its files, and each can be read."""
    assert [s.line.step for s in episode.steps] == list(range(1, len(episode.steps) + 1))
    for step in episode.steps:
        assert {p.name for p in step.folder.iterdir()} == STEP_FILES
        files = (step.folder / name for name in ("color.png", "depth.png", "camera.json"))
        load_frame(*files)
        decision, scene = step.decision(), step.scene()
        assert decision.plan.target == step.line.target
        assert decision.timings_ms == step.line.timings_ms
        assert all(mask_from_png(p.mask_png).any() for p in scene.proposals)
        outcome = json.loads((step.folder / "outcome.json").read_text())
        assert (None if outcome is None else OutcomeModel(**outcome)) == step.line.outcome
        Image.open(step.folder / "overlay.png").load()


def test_it_is_a_recorder(tmp_path: Path) -> None:
    check_recorder(EpisodeRecorder(tmp_path, header=HEADER, gripper=GRIPPER))
    assert len(read_episode(tmp_path).steps) == 3


def test_what_was_recorded_is_read_back(record, steps: list[Step]) -> None:
    recorder = record(steps)
    episode = read_episode(recorder.folder)
    assert episode.header == HEADER
    assert episode.ended is None
    check_complete(episode)
    assert [s.decision() for s in episode.steps] == [decision_to_schema(s.decision) for s in steps]
    assert [s.line.outcome for s in episode.steps] == [
        OutcomeModel(success=False, reason="missed"),
        OutcomeModel(success=True, reason="held"),
        None,
    ]
    first = load_frame(*(recorder.folder / "steps/001" / n for n in ("color.png", "depth.png", "camera.json")))
    np.testing.assert_array_equal(first.color, steps[0].decision.scene.frame.color)
    np.testing.assert_allclose(first.depth, steps[0].decision.scene.frame.depth, atol=0.0006)
    scene, seen = episode.steps[0].scene(), steps[0].decision.scene
    assert [p.mark for p in scene.proposals] == [p.mark for p in seen.proposals]
    np.testing.assert_array_equal(mask_from_png(scene.proposals[0].mask_png), seen.proposals[0].mask)


def test_finish_writes_the_published_form(record, steps: list[Step]) -> None:
    recorder = record(steps)
    episode = recorder.finish(end="goal_delivered", success=True, usage=USAGE)
    assert episode == episode_to_schema(
        steps, header=HEADER, end="goal_delivered", success=True, out=recorder.folder, usage=USAGE
    )
    text = (recorder.folder / "episode.json").read_text()
    assert EpisodeModel.model_validate_json(text) == episode
    published = json.loads(text)
    assert list(published) == [
        *("schema", "success", "steps", "end", "instruction", "goal", "preset", "seed", "out"),
        *("decisions", "outcomes", "usage"),
    ]
    assert published["usage"] == {
        "model": "gpt-4o",
        "prompt_tokens": 2400,
        "completion_tokens": 160,
        "usd": None,
        "requests": 3,
        "latency_s": 2.5,
    }
    assert published["schema"] == "thinkgrasp/episode-1"
    assert published["outcomes"][2] is None
    assert read_episode(recorder.folder).ended == episode


def test_masks_can_be_left_out_of_the_published_form(steps: list[Step]) -> None:
    episode = episode_to_schema(steps, header=HEADER, end="x", success=False, out="", usage=USAGE, with_masks=False)
    assert all(d.target is None or d.target.mask_png is None for d in episode.decisions)


def test_a_torn_last_line_is_left_out(record, steps: list[Step]) -> None:
    folder = record(steps[:2]).folder
    log = folder / "episode.jsonl"
    lines = log.read_bytes()
    for cut in (1, 10, len(lines.splitlines()[1])):
        log.write_bytes(lines[:-cut])
        assert len(read_episode(folder).steps) == 1
    log.write_bytes(lines.replace(b'"step":1', b'"step":"one"'))
    with pytest.raises(InputError, match=r"episode\.jsonl line 1 is not a recorded step: step: "):
        read_episode(folder)


class Killed(BaseException):
    """Stands for the end of the process at some call."""


@pytest.mark.parametrize("moment", range(25))
def test_dying_at_any_write_leaves_the_finished_steps(
    record, steps: list[Step], monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    recorder = record(steps[:1])
    calls = 0

    def dying(function):
        def call(*args, **kwargs):
            nonlocal calls
            calls += 1
            if calls > moment:
                raise Killed
            return function(*args, **kwargs)

        return call

    for name in ("_sync", "_append", "save_frame", "draw_overlay", "render_panel", "write_report"):
        monkeypatch.setattr(recorder_module, name, dying(getattr(recorder_module, name)))
    for name in ("mkdir", "write_bytes", "rename"):
        monkeypatch.setattr(Path, name, dying(getattr(Path, name)))
    try:
        recorder.record(steps[1].decision, steps[1].outcome)
        finished = True
    except Killed:
        finished = False
    monkeypatch.undo()
    episode = read_episode(recorder.folder)
    check_complete(episode)
    assert len(episode.steps) == 2 if finished else len(episode.steps) in (1, 2)
    assert write_report(recorder.folder).read_text().count('<article class="step"') == len(episode.steps)
    again = EpisodeRecorder(recorder.folder, header=HEADER, gripper=GRIPPER)
    again.record(steps[0].decision, steps[0].outcome)
    check_complete(read_episode(recorder.folder))


RECORD_FOREVER = """
import sys
from fakes.stages import fake_pipeline, table_frame
from thinkgrasp.episode import EpisodeHeader
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.recorder import EpisodeRecorder
from thinkgrasp.types import Outcome

decision = fake_pipeline().decide(table_frame(), "red")
header = EpisodeHeader(instruction="red", goal="red block", preset="offline", seed=0)
recorder = EpisodeRecorder(sys.argv[1], header=header, gripper=GRIPPERS["generic"])
while True:
    recorder.record(decision, Outcome(False, "missed"))
    print("recorded", flush=True)
"""


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.037])
def test_a_killed_process_leaves_all_finished_steps(tmp_path: Path, delay_s: float) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", RECORD_FOREVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent,
    )
    with process:
        assert process.stdout is not None
        finished = sum(process.stdout.readline() == "recorded\n" for _ in range(3))
        time.sleep(delay_s)
        process.send_signal(signal.SIGKILL)
        finished += process.stdout.read().count("recorded")
    episode = read_episode(tmp_path)
    assert finished >= 3
    assert len(episode.steps) in (finished, finished + 1)
    check_complete(episode)
    page = write_report(tmp_path).read_text()
    assert page.count('<article class="step"') == len(episode.steps)
    assert "Not ended" in page


def test_an_earlier_recording_is_replaced_and_nothing_else(record, steps: list[Step], tmp_path: Path) -> None:
    first = record(steps)
    first.finish(end="goal_delivered", success=True, usage=USAGE)
    (first.folder / "notes.txt").write_text("mine")
    (first.folder / "episode.webp").write_bytes(b"old")
    record(steps[:1])
    assert {p.name for p in first.folder.iterdir()} == {
        *("header.json", "episode.jsonl", "report.html", "notes.txt", "steps")
    }
    assert len(read_episode(first.folder).steps) == 1
    (tmp_path / "own" / "steps").mkdir(parents=True)
    with pytest.raises(InputError, match="was not written by a recorder; record into another folder"):
        EpisodeRecorder(tmp_path / "own", header=HEADER, gripper=GRIPPER)


def test_a_folder_without_a_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"header\.json cannot be read: No such file.*is this a recorded episode"):
        read_episode(tmp_path)
    (tmp_path / "header.json").write_text("{}")
    with pytest.raises(InputError, match=r"header\.json is not what an episode's recorder writes: instruction: Field"):
        read_episode(tmp_path)


def test_a_disk_that_cannot_be_written_is_named(record, steps: list[Step], monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = record(steps[:1])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder_module, "_append", full)
    with pytest.raises(InputError, match=r"step 2 cannot be recorded in .*: No space left on device"):
        recorder.record(steps[1].decision, steps[1].outcome)
    monkeypatch.undo()
    recorder.record(steps[1].decision, steps[1].outcome)
    check_complete(read_episode(recorder.folder))


def test_half_a_line_is_taken_back(record, steps: list[Step], monkeypatch: pytest.MonkeyPatch) -> None:
    recorder, write = record(steps[:1]), os.write
    monkeypatch.setattr(os, "write", lambda handle, data: write(handle, data[:20]))
    with pytest.raises(InputError, match="No space left"):
        recorder.record(steps[1].decision, steps[1].outcome)
    monkeypatch.undo()
    recorder.record(steps[1].decision, steps[1].outcome)
    assert [s.line.target for s in read_episode(recorder.folder).steps] == ["red", "blue"]


def test_no_frame_stays_in_memory(record, steps: list[Step]) -> None:
    import gc
    import weakref

    recorder = record([])
    decision = fake_pipeline().decide(table_frame(), "red")
    frame = weakref.ref(decision.scene.frame)
    recorder.record(decision, None)
    del decision
    gc.collect()
    assert frame() is None


def test_the_views_that_were_fused_are_kept(tmp_path: Path) -> None:
    aside = np.diag([1.0, -1.0, -1.0, 1.0])
    aside[0, 3] = 0.05
    frames = [table_frame(T_world_camera=T) for T in (np.diag([1.0, -1.0, -1.0, 1.0]), aside)]
    recorder = EpisodeRecorder(tmp_path, header=HEADER, gripper=GRIPPER)
    recorder.record(fake_pipeline().decide(fuse(frames), "the blue block"), None)
    (step,) = read_episode(tmp_path).steps
    again = [
        load_frame(folder / "color.png", folder / "depth.png", folder / "camera.json")
        for folder in (step.folder, step.folder / "view2")
    ]
    for frame, kept in zip(frames, again, strict=True):
        assert np.array_equal(frame.color, kept.color)
        assert np.array_equal(frame.T_world_camera, kept.T_world_camera)  # type: ignore[arg-type]
    assert fuse(again).others is not None
