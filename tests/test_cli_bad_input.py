"""A table of bad input through the command line: exit code 2, one clear line on stderr, nothing on stdout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fakes.frames import FrameFiles
from fakes.stages import camera_dict
from PIL import Image


def expect_error(result, *words: str) -> None:
    assert result.code == 2, result
    assert result.out == ""
    assert result.err.startswith("error: ")
    assert result.err.endswith("\n")
    assert result.err.count("\n") == 1, "one line"
    assert "Traceback" not in result.err
    assert len(result.err) < 700
    for word in words:
        assert word in result.err, result.err


def image(path, values: np.ndarray) -> None:
    Image.fromarray(values).save(path)


BREAKAGES: dict[str, tuple[Callable[[FrameFiles], object], str]] = {
    "no colour": (lambda f: f.color.unlink(), "does not exist"),
    "no depth": (lambda f: f.depth.unlink(), "does not exist"),
    "no camera": (lambda f: f.camera.unlink(), "does not exist"),
    "empty colour": (lambda f: f.color.write_bytes(b""), "is empty"),
    "empty depth": (lambda f: f.depth.write_bytes(b""), "is empty"),
    "empty camera": (lambda f: f.camera.write_bytes(b""), "is empty"),
    "colour is text": (lambda f: f.color.write_text("hello"), "cannot be decoded"),
    "depth is text": (lambda f: f.depth.write_text("hello"), "cannot be decoded"),
    "camera is no JSON": (lambda f: f.camera.write_text("fx: 600"), "not readable JSON"),
    "camera is an image": (lambda f: f.camera.write_bytes(f.color.read_bytes()), "not readable JSON"),
    "truncated colour": (lambda f: f.color.write_bytes(f.color.read_bytes()[:90]), "cannot be decoded"),
    "truncated depth": (lambda f: f.depth.write_bytes(f.depth.read_bytes()[:90]), "cannot be decoded"),
    "sizes differ": (lambda f: image(f.color, np.zeros((24, 32, 3), np.uint8)), "32x24 but depth"),
    "depth all zero": (lambda f: image(f.depth, np.zeros((48, 64), np.uint16)), "no return at all"),
    "depth 8 bit": (lambda f: image(f.depth, np.full((48, 64), 90, np.uint8)), "8-bit"),
    "depth three channels": (lambda f: image(f.depth, np.zeros((48, 64, 3), np.uint8)), "3 channels"),
    "depth float millimetres": (
        lambda f: f.depth.unlink() or Image.fromarray(np.full((48, 64), 800, np.float32)).save(f.depth, "TIFF"),
        "looks like millimetres; pass --depth-scale 0.001",
    ),
    "depth in tenths": (lambda f: image(f.depth, np.full((48, 64), 8000, np.uint16)), "tenths of a millimetre"),
    "depth too near": (lambda f: image(f.depth, np.full((48, 64), 3, np.uint16)), "too near"),
    "zero focal length": (lambda f: f.camera.write_text(json.dumps(camera_dict(fx=0))), "fx must be positive"),
    "negative focal length": (lambda f: f.camera.write_text(json.dumps(camera_dict(fy=-1))), "fy must be positive"),
    "NaN focal length": (lambda f: f.camera.write_text(json.dumps(camera_dict(fx=float("nan")))), "must be finite"),
    "focal length is text": (lambda f: f.camera.write_text(json.dumps(camera_dict(fx="600"))), "must be a number"),
    "principal point outside": (
        lambda f: f.camera.write_text(json.dumps(camera_dict(cx=640))),
        "principal point cx=640.0 lies outside",
    ),
    "camera of another size": (
        lambda f: f.camera.write_text(json.dumps(camera_dict(width=1280, height=720))),
        "is for 1280x720 images but",
    ),
    "camera lacks keys": (lambda f: f.camera.write_text(json.dumps(camera_dict(fx=None, cy=None))), "lacks fx, cy"),
    "camera pose is no pose": (
        lambda f: f.camera.write_text(json.dumps(camera_dict(T_world_camera=np.ones((4, 4)).tolist()))),
        "rigid transform",
    ),
    "negative depth scale in camera": (
        lambda f: f.camera.write_text(json.dumps(camera_dict(depth_scale=-1))),
        "depth scale must be a positive",
    ),
}


@pytest.mark.parametrize("breakage", BREAKAGES)
@pytest.mark.parametrize("flags", [[], ["--json"]], ids=["text", "json"])
def test_broken_files(cli, frame_files, breakage, flags):
    breaking, message = BREAKAGES[breakage]
    breaking(frame_files)
    expect_error(cli(*frame_files.args(), *flags), message)


@pytest.mark.parametrize(
    ("instruction", "message"),
    [
        ("", "the instruction is empty"),
        (" \t\n ", "the instruction is empty"),
        ("x" * 10_000, "10000 characters; at most 2000"),
        ("the \udcff mug", "no valid text"),
    ],
)
def test_instructions(cli, frame_files, instruction, message):
    expect_error(cli(*frame_files.args(instruction)), message)
    expect_error(cli("demo", instruction), message)


@pytest.mark.parametrize("which", ["color", "depth", "camera"])
def test_a_directory_instead_of_a_file(cli, frame_files, tmp_path, which):
    path = getattr(frame_files, which)
    args = [str(tmp_path) if a == str(path) else a for a in frame_files.args()]
    expect_error(cli(*args), "is a directory")


@pytest.mark.parametrize("scale", ["0", "-0.001", "nan", "inf", "one"])
def test_depth_scales(cli, frame_files, scale):
    expect_error(cli(*frame_files.args(), f"--depth-scale={scale}"), "depth")


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((48, 64), np.uint8), "the workspace mask allows no pixel"),
        (np.ones((10, 10), np.uint8), "is 10x10 but the images are 64x48"),
    ],
)
def test_masks(cli, frame_files, tmp_path, mask, message):
    image(tmp_path / "mask.png", mask)
    expect_error(cli(*frame_files.args(), "--workspace-mask", str(tmp_path / "mask.png")), message)


def test_a_mask_over_pixels_without_depth(cli, frame_files, tmp_path):
    depth, mask = np.full((48, 64), 800, np.uint16), np.zeros((48, 64), np.uint8)
    depth[:9], mask[:9] = 0, 255
    image(frame_files.depth, depth)
    image(tmp_path / "mask.png", mask)
    expect_error(cli(*frame_files.args(), "--workspace-mask", str(tmp_path / "mask.png")), "no pixel with depth")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--preset", "oflline"], "did you mean 'offline'"),
        (["--preset", "none.json"], "cannot be read"),
        (["--preset", "oracle"], "belongs to the simulator: use it as thinkgrasp demo --preset oracle"),
        (["--preset", "orakle"], "did you mean 'oracle'"),
        (["--planner", "ofline"], "Did you mean 'offline'"),
        (["--segmenter", "zzz"], "no segmenter named 'zzz'"),
        (["--generator", "antipodl"], "Did you mean 'antipodal'"),
        (["--scene", "zzz"], "no scene named 'zzz'"),
        (["--gripper", "tweezers"], "no gripper 'tweezers'"),
        (["--set", "planner"], "KEY=VALUE"),
        (["--set", "plannr.grid=4"], "did you mean 'planner'"),
        (["--set", "planner.no_such_setting=4"], "no_such_setting"),
        (["--set", "n_nearest=0"], "n_nearest must be"),
        (["--set", "n_nearest=many"], "n_nearest must be"),
        (["--set", "checks=width"], "checks must be a list"),
        (["--set", "checks.colision.x=1"], "did you mean 'collision'"),
        (["--seed", "-1"], "seed must be"),
        (["--seed", "x"], "--seed"),
        (["--no-such-flag"], "--no-such-flag"),
        (["extra"], "extra"),
    ],
)
def test_configuration(cli, frame_files, flags, message):
    expect_error(cli(*frame_files.args(), *flags), message)


@pytest.mark.parametrize(
    ("flag", "name", "message"),
    [
        ("--overlay", "missing/o.png", "does not exist"),
        ("--overlay", "o.txt", "must end in .png"),
        ("--overlay", "o", "must end in .png"),
        ("--overlay", "color.png", "would overwrite an input file"),
        ("--view", "missing/v.html", "does not exist"),
        ("--view", "v.png", "must end in .html"),
    ],
)
def test_outputs_are_refused_before_the_work(cli, frame_files, tmp_path, monkeypatch, flag, name, message):
    def decide(*_):
        raise AssertionError("the work was begun")

    monkeypatch.setattr("thinkgrasp.pipeline.Pipeline.decide", decide)
    expect_error(cli(*frame_files.args(), flag, str(tmp_path / name)), message)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "Expected one of"),
        (["grap"], "grap"),
        (["grasp"], "--camera"),
        (["grasp", "a.png", "b.png", "the mug"], "--camera"),
        (["grasp", "a.png", "b.png", "the mug", "--camera"], "--camera"),
        (["doctor", "--json"], "--json"),
    ],
)
def test_usage(cli, args, message):
    expect_error(cli(*args), message)


def test_names_with_line_breaks_stay_on_one_line(cli, frame_files):
    args = [a if a != str(frame_files.color) else "no\nsuch\nfile" for a in frame_files.args()]
    expect_error(cli(*args), "no such file")


class TestDemo:
    """Refused before a pile is made, except where it takes the pile to know."""

    @pytest.fixture(autouse=True)
    def needs_the_simulator(self):
        pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")

    @pytest.mark.parametrize(
        ("args", "message"),
        [
            (["--task", "clutter-06-fruti"], "Did you mean 'clutter-06-fruit'"),
            (["--task", "fruit"], "may be clutter-06-fruit or heavy-04-fruit; say which"),
            (["--preset", "oflline"], "did you mean 'offline'"),
            (["--preset", "orakle"], "did you mean 'oracle'"),
            (["--preset", "none.json"], "cannot be read"),
            (["--preset", "oracle", "--scene", "none"], "brings its own scene, planner, segmenter"),
            (["--preset", "oracle", "--set", "planner.grid=4"], "brings its own scene, planner, segmenter"),
            (["--planner", "ofline"], "Did you mean 'offline'"),
            (["--set", "planner.gridd=4"], "gridd"),
            (["--gripper", "tweezers"], "no gripper 'tweezers'"),
            (["--size", "224"], "written WIDTHxHEIGHT, for example 640x480, got '224'"),
            (["--size", "-1x5"], "written WIDTHxHEIGHT"),
            (["--size", "1000x1000"], "no image size 1000x1000 for l515; allowed are 640x480, 320x240, 224x224"),
            (["--camera", "kinect"], "Expected one of ('l515', 'd455')"),
            (["--visibility", "somewhat"], "--visibility"),
            (["--arm-planner", "RRTsun"], "no arm planner 'RRTsun'; choose one of rrt_connect, RRTstar"),
            (["--steps", "0"], "--steps must be at least 1, got 0"),
            (["--steps", "few"], "--steps"),
            (["--seed", "-1"], "seed must be a whole number of at least 0, got -1"),
            (["--port", "0", "--live"], "--port must lie in 1 to 65535, got 0"),
            (["--port", "65536", "--live"], "--port must lie in 1 to 65535"),
            (["grasp it"], "names nothing that could be put on the table; there are apple"),
            (["the bicycle"], "names nothing that could be put on the table"),
            (["the pear", "--objects", "missing"], "missing: no such folder"),
            (["the pear", "--objects", "."], "holds no object folders"),
            (["the pear", "--objects", ".", "--task", "pear"], "leave it out to use --objects"),
        ],
    )
    def test_options(self, cli, tmp_path, monkeypatch, args, message):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("thinkgrasp.sim.scenes.Pile", never)
        expect_error(cli("demo", *args, "--out", f"{tmp_path}-out"), message)

    @pytest.mark.parametrize("task", ["drink", "09-pear", "pear"])
    def test_a_task_that_lacks_what_is_asked_for_lists_what_there_is(self, cli, tmp_path, task):
        result = cli("demo", "the bicycle", "--task", task, "--out", str(tmp_path))
        assert (result.code, result.out) == (2, "")
        progress, error = result.err.splitlines()
        assert progress.startswith("making the pile of clutter-0")
        assert "serves 'the bicycle'; there is: " in error

    @pytest.mark.parametrize(
        ("urdf", "message"),
        [
            ("<robot>\n  <link name='base'>\n</robot>", "model.urdf:3: "),
            ("<robot>\n  <link name='a'/>\n  <link name='b'/>\n</robot>", "model.urdf:1: "),
            (
                "<robot><link name='base'>\n  <visual><geometry>\n    <mesh filename='no.obj'/></geometry></visual>\n"
                "</link></robot>",
                "model.urdf:3: mesh 'no.obj' does not exist",
            ),
            ("", "model.urdf"),
        ],
        ids=["not well formed", "two bases", "no mesh", "empty"],
    )
    def test_a_bad_urdf_is_named_with_its_line(self, cli, tmp_path, urdf, message):
        place = tmp_path / "things" / "gizmo"
        place.mkdir(parents=True)
        (place / "model.urdf").write_text(urdf)
        args = ["the gizmo", "--objects", str(place.parent), "--out", str(tmp_path / "out")]
        expect_error(cli("demo", *args), message)

    def test_own_objects_without_what_is_asked_for(self, cli, tmp_path):
        place = tmp_path / "things" / "gizmo"
        place.mkdir(parents=True)
        shape = "<geometry><box size='0.05 0.05 0.05'/></geometry>"
        (place / "model.urdf").write_text(
            "<robot><link name='base'><inertial><mass value='0.1'/></inertial>"
            f"<visual>{shape}</visual><collision>{shape}</collision></link></robot>"
        )
        args = ["the xylophone", "--objects", str(place.parent), "--out", str(tmp_path / "out")]
        expect_error(cli("demo", *args), "'the xylophone' names nothing", "your objects are gizmo")

    def test_the_folder_is_a_file(self, cli, tmp_path):
        (tmp_path / "file").write_bytes(b"x")
        expect_error(cli("demo", "--out", str(tmp_path / "file")), "cannot be used")
        expect_error(cli("demo", "--out", str(tmp_path / "file" / "demo")), "cannot be used")

    @pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder that nobody can write")
    def test_the_folder_cannot_be_written(self, cli):
        expect_error(cli("demo", "--out", "/proc/thinkgrasp"), "cannot be used")


def never(*_: object) -> None:
    raise AssertionError("the work was begun")
