"""Frames that are valid but odd end in a decision, never in an exception: the offline preset as a whole."""

from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp import make_pipeline
from thinkgrasp.schema import decision_to_schema
from thinkgrasp.testing import sample_frame
from thinkgrasp.types import CameraIntrinsics, Frame

RNG = np.random.default_rng(0)


def frame(depth: np.ndarray, color: np.ndarray | None = None, workspace: np.ndarray | None = None) -> Frame:
    h, w = depth.shape
    if color is None:
        color = np.full((h, w, 3), 128, np.uint8)
    camera = CameraIntrinsics(w, h, max(w, 2), max(w, 2), (w - 1) / 2, (h - 1) / 2)
    return Frame(color, depth.astype(np.float32), camera, workspace=workspace)


def one_pixel(h: int = 60, w: int = 80) -> np.ndarray:
    depth = np.zeros((h, w))
    depth[h // 2, w // 2] = 0.7
    return depth


def noise_color(h: int, w: int) -> np.ndarray:
    return RNG.integers(0, 256, (h, w, 3), dtype=np.uint8)


def tilted(h: int = 60, w: int = 80) -> np.ndarray:
    return 0.8 + np.linspace(0.3, 0, h)[:, None] + np.zeros((1, w))


def sample(**changes: object) -> Frame:
    base = sample_frame()
    values = {n: getattr(base, n) for n in ("color", "depth", "camera", "T_world_camera", "workspace")} | changes
    return Frame(**values)  # type: ignore[arg-type]


FRAMES = {
    "one by one": frame(np.full((1, 1), 0.8)),
    "two by two": frame(np.full((2, 2), 0.8)),
    "one row": frame(np.full((1, 50), 0.8)),
    "one column": frame(np.full((50, 1), 0.8)),
    "five by seven": frame(RNG.uniform(0.5, 1, (5, 7))),
    "a wall": frame(np.full((60, 80), 0.8)),
    "a tilted plane": frame(tilted()),
    "a wall with noisy colour": frame(np.full((60, 80), 0.8), noise_color(60, 80)),
    "one pixel with depth": frame(one_pixel()),
    "depth is noise": frame(RNG.uniform(0.3, 2, (60, 80)), noise_color(60, 80)),
    "sparse noise": frame(np.where(RNG.random((60, 80)) < 0.05, RNG.uniform(0.3, 2, (60, 80)), 0)),
    "half is NaN": frame(np.where(RNG.random((60, 80)) < 0.5, tilted(), np.nan)),
    "a step": frame(np.where(np.arange(80) < 40, 0.6, 0.9) + np.zeros((60, 1))),
    "very near": frame(np.full((60, 80), 0.06)),
    "very far": frame(np.full((60, 80), 12.0)),
    "black": sample(color=np.zeros((240, 320, 3), np.uint8)),
    "noisy colour": sample(color=noise_color(240, 320)),
    "upside down": sample(
        color=sample_frame().color[::-1].copy(), depth=sample_frame().depth[::-1].copy(), T_world_camera=None
    ),
    "workspace of one pixel": sample(workspace=np.arange(240 * 320).reshape(240, 320) == 120 * 320 + 160),
    "workspace with holes": sample(workspace=RNG.random((240, 320)) < 0.5),
    "nothing on the table": sample_frame(things=False),
    "a quarter of the depth missing": sample_frame(dropout=0.25),
    "a pose that is wrong": sample(T_world_camera=np.eye(4)),
}


@pytest.fixture(scope="module")
def offline():
    return make_pipeline("offline")


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.filterwarnings("error")
def test_odd_frames_end_in_a_decision(offline, name):
    for instruction in ("the red box", "something to drink from"):
        decision = offline.decide(FRAMES[name], instruction)
        model = decision_to_schema(decision)
        assert model.status in ("grasp", "no_grasp", "no_target")
        assert (model.grasp is not None) == (model.status == "grasp")
        assert model.plan.rationale


@pytest.mark.parametrize("name", ["one by one", "a wall", "depth is noise", "black"])
def test_odd_frames_in_strict_mode(name):
    decision = make_pipeline("offline", scene=None).decide(FRAMES[name], "the red box")
    assert decision.status in ("grasp", "no_grasp", "no_target")


@pytest.mark.parametrize(
    "instruction",
    [
        "!!!",
        "12345",
        "the the the the",
        "🤖",
        "杯子",
        "left",
        "on",
        "by its handle",
        "the cup behind the bottle next to the bowl under the mug on the left",
        "not the red box",
        "x" * 2000,
        "red " * 499,
        "[bold]the red box[/bold]",
        "the red box\nand the mug",
        "'; DROP TABLE objects; --",
        "\x00\x01\x02",
    ],
)
def test_odd_instructions_end_in_a_decision(offline, instruction):
    decision = offline.decide(sample_frame(), instruction)
    assert decision.status in ("grasp", "no_grasp", "no_target")
    assert decision.plan.rationale
    decision_to_schema(decision).to_json()
