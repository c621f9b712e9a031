"""The overlay: what is drawn where, for every status, image size and kind of text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.types import Decision, Degradation, Grasp
from thinkgrasp.viz import glyphs
from thinkgrasp.viz.glyphs import plain_text
from thinkgrasp.viz.overlay import draw_overlay

GRIPPER = GRIPPERS["robotiq_2f85"]
Make = Callable[..., Decision]


def changed(decision: Decision) -> tuple[np.ndarray, int]:
    """Where the picture differs from the plain enlarged image, and the enlargement."""
    color = decision.scene.frame.color
    picture = np.asarray(draw_overlay(decision, GRIPPER)).astype(int)
    scale = picture.shape[1] // color.shape[1]
    plain = np.kron(color, np.ones((scale, scale, 1), np.uint8)).astype(int)
    return np.abs(picture[: len(plain)] - plain).max(axis=2) > 12, scale


def close_to(picture: Image.Image, color: tuple[int, int, int], tolerance: int = 40) -> np.ndarray:
    return np.abs(np.asarray(picture).astype(int) - color).max(axis=2) <= tolerance


@pytest.mark.parametrize(
    ("status", "width", "height"),
    [("grasp", 64, 48), ("no_grasp", 64, 48), ("no_target", 64, 48), ("no_grasp", 320, 240), ("grasp", 1280, 720)],
)
def test_every_status_and_size(make_decision: Make, status: str, width: int, height: int) -> None:
    picture = draw_overlay(make_decision(status, width=width, height=height), GRIPPER)
    scale = -(-480 // width)
    assert picture.mode == "RGB"
    assert picture.width == width * scale
    assert height * scale + 40 < picture.height < height * scale + 200


def test_target_outline_follows_the_mask(make_decision: Make) -> None:
    decision = make_decision("no_grasp", width=640, height=480, marks=False)
    amber = close_to(draw_overlay(decision, GRIPPER), glyphs.TARGET)[:480]
    assert decision.target is not None
    x0, y0, x1, y1 = decision.target.box_xyxy
    v, u = np.nonzero(amber[: y1 + 2])
    assert (u.min(), u.max()) == pytest.approx((x0, x1), abs=3)
    assert v.min() == pytest.approx(y0, abs=3)
    inside = amber & decision.target.mask
    assert inside.sum() > 0.1 * decision.target.mask.sum()


def test_gripper_is_drawn_at_the_grasp_only_when_there_is_one(make_decision: Make) -> None:
    decision = make_decision("grasp", width=640, height=480, marks=False)
    assert decision.grasp is not None
    none = np.asarray(draw_overlay(make_decision("no_grasp", width=640, height=480, marks=False), GRIPPER)).astype(int)
    picture = np.asarray(draw_overlay(decision, GRIPPER)).astype(int)
    v, u = np.nonzero(np.abs(picture[:480] - none[:480]).max(axis=2) > 20)
    assert len(u) > 500
    tips = decision.grasp.position + np.outer([-0.5, 0.5], decision.grasp.rotation[:, 0] * decision.grasp.width_m)
    for tip in decision.scene.frame.camera.project(tips):
        assert np.hypot(u - tip[0], v - tip[1]).min() < 4


@pytest.mark.parametrize("z", [0.005, 0.03, -0.5])
def test_gripper_at_or_behind_the_camera_does_not_fail(make_decision: Make, z: float) -> None:
    decision = make_decision()
    grasp = Grasp(np.diag([1.0, -1.0, -1.0]), np.array([0.01, 0.0, z]), 0.05, 0.5)
    draw_overlay(replace(decision, grasp=grasp), GRIPPER)
    draw_overlay(replace(decision, grasp=grasp, preferred_point=np.array([0.0, 0.0, z])), GRIPPER)


def test_every_proposal_gets_a_mark_inside_its_mask(make_decision: Make) -> None:
    decision = make_decision("no_target", width=640, height=480)
    light = close_to(draw_overlay(decision, GRIPPER), glyphs.PAPER, 16)[:480]
    for proposal in decision.scene.proposals:
        assert (light & proposal.mask).sum() > 25, proposal.mark
    without, _ = changed(make_decision("no_target", width=640, height=480, marks=False))
    assert not without.any(), "nothing to draw but the text"


@pytest.mark.parametrize(
    "text",
    [
        "日本語のバナナ",
        "أريد الموزة",
        "🍌🤖 \N{ZERO WIDTH JOINER}",
        "a\x00b\x1b[31m\n\r\tc",
        "half a pair \ud83c alone",
        "x" * 2000,
        "word " * 400,
        "\u202e",
        "",
    ],
)
def test_any_text_is_drawn_or_left_out_but_never_fails(make_decision: Make, text: str) -> None:
    degraded = (Degradation("plan", text, text),)
    decision = make_decision("no_grasp", width=64, height=48, instruction=text, rationale=text, degraded=degraded)
    assert decision.target is not None
    picture = draw_overlay(replace(decision, target=replace(decision.target, label=text)), GRIPPER)
    assert picture.height < 48 * 8 + 140


def test_plain_text_is_one_printable_line() -> None:
    assert plain_text(" a\n\tb\x00 c \u202e") == "a b c"
    assert plain_text("\ud800x").isprintable()


def test_same_decision_same_picture_and_input_untouched(make_decision: Make) -> None:
    decision = make_decision()
    before = decision.scene.frame.color.copy()
    a, b = (np.asarray(draw_overlay(decision, GRIPPER)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(before, decision.scene.frame.color)
