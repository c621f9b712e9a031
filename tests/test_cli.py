"""The command line on good input: results on stdout, progress on stderr, exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fakes.stages import table_frame
from PIL import Image

from thinkgrasp import __version__
from thinkgrasp.cameras.files import load_frame
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.config import PRESETS
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.schema import DecisionModel, mask_from_png
from thinkgrasp.testing import sample_frame


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[str, str, str]:
    """A rendered table top, as files."""
    color, depth, camera = save_frame(sample_frame(), tmp_path_factory.mktemp("frame"))
    return str(color), str(depth), str(camera)


def grasp_args(files: tuple[str, str, str], instruction: str = "the red box", *more: str) -> list[str]:
    color, depth, camera = files
    return ["grasp", color, depth, instruction, "--camera", camera, *more]


class TestGrasp:
    def test_json_is_the_schema_and_nothing_else(self, cli, files):
        result = cli(*grasp_args(files, "the red box", "--json"))
        assert (result.code, result.err) == (0, "")
        model = DecisionModel.model_validate_json(result.out)
        assert model.status == "grasp"
        assert model.grasp is not None
        assert model.target is not None
        assert model.version == __version__
        frame = load_frame(*files)
        T = frame.T_world_camera
        tcp = np.linalg.inv(T) @ [*model.grasp.position_m, 1]
        u, v = frame.camera.project(tcp[:3])
        x0, y0, x1, y1 = model.target.box_xyxy
        assert x0 <= u < x1
        assert y0 <= v < y1
        assert mask_from_png(model.target.mask_png).shape == frame.depth.shape

    def test_summary_for_people(self, cli, files):
        result = cli(*grasp_args(files))
        assert result.code == 0
        assert result.out.startswith("grasp found")
        for word in ("instruction", "target", "why", "position", "quaternion", "opening", "candidates", "time"):
            assert word in result.out
        assert "\x1b" not in result.out, "no colours where nobody sees them"

    def test_nothing_fits_is_exit_one(self, cli, files):
        result = cli(*grasp_args(files, "a bicycle", "--json"))
        assert result.code == 1
        data = json.loads(result.out)
        assert data["status"] in ("no_target", "no_grasp")
        assert data["grasp"] is None
        assert data["plan"]["rationale"]

    def test_nothing_survives_is_exit_one(self, cli, files, tmp_path):
        gripper = {
            "name": "tiny",
            "max_width_m": 0.002,
            "finger_length_m": 0.04,
            "finger_thickness_m": 0.01,
            "finger_breadth_m": 0.02,
            "palm_size_m": [0.1, 0.06, 0.05],
            "pad_length_m": 0.03,
        }
        (tmp_path / "tiny.json").write_text(json.dumps(gripper))
        result = cli(*grasp_args(files, "the red box", "--gripper", str(tmp_path / "tiny.json")))
        assert result.code == 1
        assert result.out.startswith("no grasp")

    def test_pictures(self, cli, files, tmp_path):
        overlay, view = tmp_path / "o.png", tmp_path / "v.html"
        result = cli(*grasp_args(files, "the red box", "--overlay", str(overlay), "--view", str(view)))
        assert result.code == 0
        with Image.open(overlay) as picture:
            assert picture.width >= 320
        assert "<html" in view.read_text(encoding="utf-8")[:400].lower()
        assert sorted(p.name for p in tmp_path.iterdir()) == ["o.png", "v.html"]

    def test_same_seed_same_answer(self, cli, files):
        def without_times(text: str) -> dict:
            data = json.loads(text)
            del data["timings_ms"]
            return data

        a, b = (cli(*grasp_args(files, "the mug", "--json", "--seed", "3")).out for _ in range(2))
        assert without_times(a) == without_times(b)

    def test_settings_reach_the_stages(self, cli, files):
        result = cli(*grasp_args(files, "the red box", "--json", "--set", "n_nearest=1", "--set", "checks=[]"))
        data = json.loads(result.out)
        assert data["alternatives"] == []
        assert [step["check"] for step in data["funnel"]] == ["candidates"]

    def test_workspace_mask(self, cli, files, tmp_path):
        allowed = np.zeros((240, 320), np.uint8)
        allowed[:, 160:] = 1
        Image.fromarray(allowed).save(tmp_path / "m.png")
        result = cli(*grasp_args(files, "the red box", "--json", "--workspace-mask", str(tmp_path / "m.png")))
        data = json.loads(result.out)
        if data["target"] is not None:
            assert data["target"]["box_xyxy"][0] >= 157, "a mask's outline may be a pixel or two beyond the edge"
        if data["grasp"] is not None:
            frame = load_frame(*files)
            tcp = np.linalg.inv(frame.T_world_camera) @ [*data["grasp"]["position_m"], 1]
            assert frame.camera.project(tcp[:3])[0] >= 159.5

    def test_strict_mode_is_reachable(self, cli, files):
        result = cli(*grasp_args(files, "the red box", "--scene", "none", "--json"))
        assert result.code in (0, 1)
        assert json.loads(result.out)["plan"]["mark"] is None


def encode_color(path: Path, kind: str, color: np.ndarray) -> Path:
    image = Image.fromarray(color)
    if kind == "rgba":
        image.putalpha(Image.fromarray(np.full(color.shape[:2], 7, np.uint8)))
    elif kind == "grey":
        image = image.convert("L")
    elif kind == "grey16":
        image = Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 257)
    elif kind == "palette":
        image = image.quantize(64)
    target = path / (f"{kind}.jpg" if kind == "jpeg" else f"{kind}.png")
    image.save(target, quality=95) if kind == "jpeg" else image.save(target)
    return target


@pytest.mark.parametrize("kind", ["rgba", "grey", "grey16", "palette", "jpeg"])
def test_unusual_colour_gives_a_result(cli, files, tmp_path, kind):
    color = encode_color(tmp_path, kind, sample_frame().color)
    result = cli(*grasp_args((str(color), *files[1:]), "the box", "--json"))
    assert result.code == 0, result.err
    assert json.loads(result.out)["status"] == "grasp"


class TestLists:
    def test_version(self, cli):
        assert cli("--version").out == f"thinkgrasp {__version__}\n"

    def test_plugins(self, cli):
        result = cli("plugins")
        assert result.code == 0
        for name in ("scene:", "geometric", "offline", "antipodal", "thinkgrasp.checks", "EpisodeRecorder"):
            assert name in result.out

    def test_presets(self, cli):
        result = cli("presets")
        assert result.code == 0
        for name, config in PRESETS.items():
            assert f"{name}:" in result.out
            assert config.planner.name in result.out
        assert "oracle: in simulation only (thinkgrasp demo --preset oracle)" in result.out

    def test_doctor(self, cli):
        result = cli("doctor")
        assert result.code == 0
        assert "self-check passed" in result.out
        for extra in ("sim", "vlm", "langsam", "graspnet", "server", "viz", "ur", "realsense"):
            assert f"  {extra} " in result.out
        assert "numpy" in result.out

    @pytest.mark.parametrize("command", [[], ["grasp"], ["demo"], ["doctor"]])
    def test_help(self, cli, command):
        result = cli(*command, "--help")
        assert result.code == 0
        assert "usage: thinkgrasp" in result.out


class TestBugs:
    @pytest.fixture
    def broken(self, monkeypatch):
        def decide(self, frame, instruction, memory=None):
            raise RuntimeError("two\nlines")

        monkeypatch.setattr(Pipeline, "decide", decide)

    def test_a_bug_is_one_line_and_exit_three(self, cli, files, broken):
        result = cli(*grasp_args(files))
        assert result.code == 3
        assert result.err == "error: RuntimeError: two lines (this is a bug; --debug shows where)\n"
        assert result.out == ""

    def test_debug_shows_the_traceback(self, cli, files, broken):
        result = cli(*grasp_args(files), "--debug")
        assert result.code == 3
        assert "Traceback" in result.err
        assert result.err.splitlines()[-1].startswith("error: RuntimeError")

    def test_a_result_is_not_lost_in_half_written_files(self, cli, files, tmp_path, monkeypatch):
        from thinkgrasp.viz import overlay

        def fail(decision, gripper):
            raise RuntimeError("no ink")

        monkeypatch.setattr(overlay, "draw_overlay", fail)
        result = cli(*grasp_args(files, "the red box", "--overlay", str(tmp_path / "o.png")))
        assert result.code == 3
        assert list(tmp_path.iterdir()) == []

    def test_interrupt(self, cli, files, monkeypatch):
        def decide(self, frame, instruction, memory=None):
            raise KeyboardInterrupt

        monkeypatch.setattr(Pipeline, "decide", decide)
        result = cli(*grasp_args(files))
        assert (result.code, result.err) == (130, "interrupted\n")


def run(*args: str, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "thinkgrasp.cli", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)


class TestRealProcess:
    def test_a_grasp(self, files):
        done = run(*grasp_args(files, "the red box", "--json"))
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["status"] == "grasp"

    def test_bad_input(self, files):
        done = run(*grasp_args(files, ""))
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == "error: the instruction is empty; say what to take, for example 'the red box'\n"

    @pytest.mark.skipif(os.name != "posix", reason="uses a POSIX pipe")
    def test_a_reader_that_goes_away(self):
        read, write = os.pipe()
        os.close(read)
        try:
            done = subprocess.run(
                [sys.executable, "-m", "thinkgrasp.cli", "plugins"],
                stdout=write,
                stderr=subprocess.PIPE,
                timeout=60,
                check=False,
            )
        finally:
            os.close(write)
        assert done.stderr == b""
        assert done.returncode == 0

    @pytest.mark.parametrize("flags", [[], ["--json"]])
    def test_a_terminal_that_knows_only_ascii(self, files, flags):
        done = run(*grasp_args(files, "the réd box", *flags), env={**os.environ, "PYTHONIOENCODING": "ascii"})
        assert done.returncode in (0, 1), done.stderr
        if flags:
            assert json.loads(done.stdout)["instruction"] == "the réd box"


def test_the_fakes_frame_also_runs_through_the_offline_preset(cli, tmp_path):
    """A frame far from the rendered ones: two flat blocks seen from straight above, no pose."""
    paths = save_frame(table_frame(width=160, height=120), tmp_path)
    result = cli(*grasp_args(tuple(map(str, paths)), "the red block", "--json"))
    assert result.code in (0, 1)
    assert json.loads(result.out)["status"] in ("grasp", "no_grasp", "no_target")
