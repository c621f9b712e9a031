"""`thinkgrasp demo`: a whole episode through the real command, what it says, writes, and leaves when it is killed."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from thinkgrasp.cameras.files import load_frame
from thinkgrasp.config import load_config, override
from thinkgrasp.episode import EpisodeModel, read_episode
from thinkgrasp.sim.views import camera
from thinkgrasp.testbed import for_the_loop

EASY = ("--task", "clutter-06-fruit", "--visibility", "visible", "--seed", "1", "--size", "224x224")
"""Three fruits on top of the pile."""
HARD = ("--task", "clutter-09-pear", "--visibility", "hidden", "--seed", "0", "--size", "224x224", "--no-video")
"""One pear below the pile: more than one step."""

STEP_FILES = {
    *("color.png", "depth.png", "camera.json", "decision.json", "scene.json", "outcome.json"),
    *("overlay.png", "panel.html"),
}

CUBE = """\
<robot name="gizmo">
  <link name="base">
    <inertial><mass value="0.1"/></inertial>
    <visual><geometry><box size="0.05 0.05 0.05"/></geometry></visual>
    <collision><geometry><box size="0.05 0.05 0.05"/></geometry></collision>
  </link>
</robot>
"""


@dataclass(frozen=True)
class Run:
    """A finished command and its folder."""

    code: int
    out: str
    err: str
    folder: Path

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self.out)


def command(*args: str) -> list[str]:
    return [sys.executable, "-m", "thinkgrasp.cli", "demo", *args]


def run(folder: Path, args: Sequence[str], **env: str) -> Run:
    """Run the real command in a process of its own."""
    done = subprocess.run(
        command(*args, "--out", str(folder)),
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
        env={**os.environ, **env},
    )
    return Run(done.returncode, done.stdout, done.stderr, folder)


def without_times(episode: dict[str, Any]) -> dict[str, Any]:
    del episode["out"], episode["preset"]
    for decision in episode["decisions"]:
        del decision["timings_ms"]
    return episode


@pytest.fixture(scope="module")
def delivered(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("demo") / "new" / "folder"
    return run(folder, [*EASY, "--no-video", "--json"], PYTHONHASHSEED="1")


class TestEpisode:
    def test_stdout_is_the_schema_and_nothing_else(self, delivered):
        assert delivered.code == 0, delivered.err
        model = EpisodeModel.model_validate_json(delivered.out)
        assert (model.success, model.end) == (True, "goal_delivered")
        assert (model.instruction, model.preset, model.seed) == ("I need a fruit", "offline", 1)
        assert model.out == str(delivered.folder)
        assert model.goal
        assert 1 <= model.steps == len(model.decisions) == len(model.outcomes)
        last = model.outcomes[-1]
        assert last is not None
        assert last.success
        assert set(delivered.data) == {
            *("schema", "success", "steps", "end", "instruction", "goal", "preset", "seed", "out"),
            *("decisions", "outcomes", "usage"),
        }
        assert delivered.data["schema"] == "thinkgrasp/episode-1"

    def test_progress_is_on_stderr_one_line_a_step(self, delivered):
        lines = delivered.err.splitlines()
        assert sum(line.startswith("step ") for line in lines) == delivered.data["steps"]
        assert lines[-1] == f"open {(delivered.folder / 'report.html').resolve()}"
        assert "oracle" not in delivered.err

    def test_everything_is_in_the_folder(self, delivered):
        assert {p.name for p in delivered.folder.iterdir()} == {
            *("header.json", "episode.jsonl", "episode.json", "report.html", "config.json", "steps"),
        }
        assert json.loads((delivered.folder / "episode.json").read_text()) == delivered.data
        recorded = read_episode(delivered.folder)
        assert recorded.ended is not None
        assert [step.decision() for step in recorded.steps] == list(recorded.ended.decisions)
        for step in recorded.steps:
            assert {p.name for p in step.folder.iterdir()} == STEP_FILES
            assert step.scene().proposals

    def test_the_same_seed_gives_the_same_episode_in_another_process(self, delivered, tmp_path):
        again = run(tmp_path / "again", [*EASY, "--no-video", "--json"], PYTHONHASHSEED="2")
        assert without_times(again.data) == without_times(delivered.data)

    def test_the_saved_configuration_runs_again(self, cli, delivered, tmp_path):
        saved = delivered.folder / "config.json"
        assert load_config(saved) == for_the_loop(override(load_config("offline"), "seed", 1))
        without_seed = [a for a in EASY if a not in ("--seed", "1")]
        args = [*without_seed, "--no-video", "--json", "--preset", str(saved), "--out", str(tmp_path)]
        again = json.loads(cli("demo", *args).out)
        assert again["preset"] == str(saved)
        assert without_times(again) == without_times(delivered.data)


def test_a_goal_that_is_not_delivered_is_exit_one(cli, tmp_path):
    result = cli("demo", *HARD, "--steps", "1", "--out", str(tmp_path))
    assert result.code == 1, result.err
    lines = result.out.splitlines()
    assert lines[0] == "goal not delivered: give me the pear"
    assert [line.split()[:2] for line in lines[1:4]] == [["goal", "pear"], ["preset", "offline"], ["steps", "1"]]
    assert "step_limit" in lines[4]
    assert lines[5].split()[-1] == str(tmp_path / "report.html")
    ended = read_episode(tmp_path).ended
    assert ended is not None
    assert (ended.success, ended.end, ended.steps) == (False, "step_limit", 1)


def test_the_oracle_is_named_everywhere_and_the_video_is_made(tmp_path):
    result = run(tmp_path, [*EASY, "--preset", "oracle", "--json"])
    assert result.code == 0, result.err
    assert "oracle" in result.err.splitlines()[0]
    model = EpisodeModel.model_validate_json(result.out)
    assert model.preset == "oracle"
    assert all(d.plan.rationale.startswith("[oracle: ") for d in model.decisions)
    assert "oracle" in (tmp_path / "report.html").read_text(encoding="utf-8")
    with Image.open(tmp_path / "episode.webp") as video:
        assert (video.format, video.width) == ("WEBP", 320)
        assert getattr(video, "n_frames", 1) > 10
    load_config(tmp_path / "config.json")


def test_the_oracle_is_named_for_people(cli, tmp_path, monkeypatch):
    captions: list[str] = []
    monkeypatch.setattr(
        "thinkgrasp.viz.video.VideoWriter.add", lambda video, frame, caption="": captions.append(caption)
    )
    result = cli("demo", *EASY, "--preset", "oracle", "--steps", "2", "--out", str(tmp_path))
    assert "  preset    oracle\n" in result.out
    assert all(caption.startswith("[oracle] ") for caption in captions)
    assert captions[0] == "[oracle] I need a fruit"


def test_sensor_and_noise(cli, tmp_path):
    frames = []
    for flags in ([], ["--no-noise"]):
        folder = tmp_path / f"out{len(frames)}"
        result = cli("demo", *EASY, "--no-video", "--camera", "d455", "--steps", "1", *flags, "--out", str(folder))
        assert result.code in (0, 1), result.err
        step = folder / "steps" / "001"
        frames.append(load_frame(step / "color.png", step / "depth.png", step / "camera.json"))
    noisy, exact = frames
    assert noisy.camera == exact.camera == camera("d455", (224, 224))
    np.testing.assert_array_equal(noisy.color, exact.color)
    assert (exact.depth > 0).all()
    assert (noisy.depth != exact.depth).mean() > 0.3


def test_strict_mode(cli, tmp_path):
    """Without a scene stage there may be nothing to take, and that is an episode as well."""
    args = [*EASY, "--no-video", "--scene", "none", "--steps", "1", "--json", "--out", str(tmp_path)]
    result = cli("demo", *args)
    assert result.code in (0, 1), result.err
    model = EpisodeModel.model_validate_json(result.out)
    assert model.steps == 1
    assert model.decisions[0].plan.mark is None
    assert load_config(tmp_path / "config.json").scene is None


def test_objects_of_ones_own(cli, tmp_path):
    place = tmp_path / "things" / "gizmo"
    place.mkdir(parents=True)
    (place / "model.urdf").write_text(CUBE)
    args = ["the gizmo", "--objects", str(place.parent), "--visibility", "visible", "--size", "224x224", "--no-video"]
    result = cli("demo", *args, "--preset", "oracle", "--json", "--out", str(tmp_path / "out"))
    assert result.code == 0, result.err
    assert json.loads(result.out)["goal"] == "gizmo"


@pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)], ids=["killed", "Ctrl-C"])
def test_an_end_in_the_middle_leaves_the_finished_steps(tmp_path, sent, code):
    said: list[str] = []
    with subprocess.Popen(
        command(*HARD, "--json", "--out", str(tmp_path)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background job ignores it
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        for line in process.stderr:
            said.append(line)
            if line.startswith("step 1: "):
                break
        process.send_signal(sent)
        said += process.stderr
        out = process.stdout.read()
    assert (process.returncode, out) == (code, ""), said
    if sent == signal.SIGINT:
        assert said[-1] == "interrupted\n"
    assert "Traceback" not in "".join(said)

    recorded = read_episode(tmp_path)
    assert recorded.ended is None
    assert recorded.header.goal == "pear"
    assert recorded.steps
    for step in recorded.steps:
        assert step.decision().status == step.line.status
        assert {p.name for p in step.folder.iterdir()} == STEP_FILES
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Not ended" in page
    assert (recorded.steps[0].folder / "panel.html").read_text(encoding="utf-8") in page


def test_live_goes_to_a_free_port(tmp_path):
    pytest.importorskip("viser", reason="needs thinkgrasp[viz]")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = run(tmp_path, [*EASY, "--no-video", "--live", "--port", str(port), "--steps", "1", "--json"])
    assert result.code in (0, 1), result.err
    EpisodeModel.model_validate_json(result.out)
    (told,) = (line for line in result.err.splitlines() if line.startswith("follow the episode at "))
    assert told.startswith("follow the episode at http://localhost:")
    assert not told.endswith(f":{port}")
