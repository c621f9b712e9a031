"""Colour names, white balance and shading, against the colours that carry these names in CSS."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinkgrasp.perception.color import (
    COLOR_NAMES,
    MAX_CAST,
    balance_white,
    color_memberships,
    lab_from_rgb,
    name_colors,
)

RGB = st.tuples(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))

NAMED = {
    "red": [(255, 0, 0), (220, 20, 60), (178, 34, 34), (200, 30, 30)],
    "orange": [(255, 165, 0), (255, 140, 0), (255, 127, 80)],
    "yellow": [(255, 255, 0), (255, 215, 0), (230, 200, 50)],
    "green": [(0, 128, 0), (34, 139, 34), (50, 205, 50), (46, 139, 87)],
    "blue": [(0, 0, 255), (65, 105, 225), (70, 130, 180), (30, 144, 255), (0, 0, 139)],
    "purple": [(128, 0, 128), (148, 0, 211), (102, 51, 153)],
    "pink": [(255, 192, 203), (255, 105, 180), (255, 182, 193), (255, 20, 147)],
    "brown": [(139, 69, 19), (160, 82, 45), (101, 67, 33), (92, 64, 51)],
    "black": [(0, 0, 0), (20, 20, 20), (30, 30, 34)],
    "white": [(255, 255, 255), (245, 245, 245), (255, 250, 240)],
    "grey": [(128, 128, 128), (105, 105, 105), (150, 150, 150)],
}


def best_name(rgb: tuple[int, int, int]) -> str:
    shares = color_memberships(lab_from_rgb(np.array([rgb], np.uint8)))[0]
    return COLOR_NAMES[int(np.argmax(shares))]


@pytest.mark.parametrize(("name", "rgb"), [(n, c) for n, colors in NAMED.items() for c in colors])
def test_known_colours_get_their_names(name: str, rgb: tuple[int, int, int]) -> None:
    assert best_name(rgb) == name


def test_the_table_has_every_name() -> None:
    assert set(NAMED) == set(COLOR_NAMES)


@pytest.mark.parametrize(
    ("rgb", "lab"),
    [
        ((255, 255, 255), (100.0, 0.0, 0.0)),
        ((0, 0, 0), (0.0, 0.0, 0.0)),
        ((255, 0, 0), (53.24, 80.09, 67.20)),
        ((0, 255, 0), (87.73, -86.18, 83.18)),
        ((0, 0, 255), (32.30, 79.19, -107.86)),
        ((128, 128, 128), (53.59, 0.0, 0.0)),
    ],
)
def test_lab_of_the_srgb_primaries(rgb: tuple[int, int, int], lab: tuple[float, float, float]) -> None:
    """Reference values of CIE Lab under D65; black is special, its lightness is linear in the standard."""
    found = lab_from_rgb(np.array(rgb, np.uint8))
    if rgb == (0, 0, 0):
        assert abs(found[1]) < 1e-3
        assert abs(found[2]) < 1e-3
        assert found[0] < 1.0
    else:
        np.testing.assert_allclose(found, lab, atol=0.05)


@given(st.lists(RGB, min_size=1, max_size=20))
def test_memberships_are_shares(colors: list[tuple[int, int, int]]) -> None:
    shares = color_memberships(lab_from_rgb(np.array(colors, np.uint8)))
    assert shares.shape == (len(colors), len(COLOR_NAMES))
    assert (shares >= -1e-6).all()
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-4)


@given(RGB, st.integers(1, 3))
def test_neighbouring_colours_have_neighbouring_memberships(rgb: tuple[int, int, int], step: int) -> None:
    """Soft names: no colour's share jumps when a channel changes by a little."""
    near = tuple(min(255, c + step) for c in rgb)
    a, b = color_memberships(lab_from_rgb(np.array([rgb, near], np.uint8)))
    assert np.abs(a - b).max() < 0.35


def painted(*blocks: tuple[tuple[int, int, int], int], light: tuple[float, float, float] = (1, 1, 1)) -> np.ndarray:
    """An image of colour blocks (rgb, rows) of 60 columns under a light."""
    rows = [np.full((n, 60, 3), rgb, float) for rgb, n in blocks]
    return np.clip(np.rint(np.concatenate(rows) * light), 0, 255).astype(np.uint8)


SHEET = (((225, 225, 225), 30), ((186, 34, 36), 20), ((40, 90, 190), 20), ((60, 150, 80), 20))


@pytest.mark.parametrize("light", [(1.0, 0.93, 0.80), (0.85, 0.95, 1.0), (1.0, 0.88, 0.88)])
def test_white_balance_removes_a_cast(light: tuple[float, float, float]) -> None:
    lab = lab_from_rgb(painted(*SHEET, light=light))
    balanced = balance_white(lab, np.ones(lab.shape[:2], bool))
    before, after = (np.hypot(x[:30, :, 1], x[:30, :, 2]).mean() for x in (lab, balanced))
    assert before > 4
    assert after < 0.2 * before
    true = lab_from_rgb(painted(*SHEET))
    for rows in (slice(30, 50), slice(50, 70)):
        worse = np.linalg.norm(lab[rows, :, 1:] - true[rows, :, 1:], axis=2).mean()
        assert np.linalg.norm(balanced[rows, :, 1:] - true[rows, :, 1:], axis=2).mean() < worse + 2


def test_white_balance_leaves_neutral_images_alone() -> None:
    lab = lab_from_rgb(painted(*SHEET))
    np.testing.assert_allclose(balance_white(lab, np.ones(lab.shape[:2], bool)), lab, atol=0.05)


def test_white_balance_needs_something_pale_to_judge_by() -> None:
    lab = lab_from_rgb(painted(*SHEET[1:]))
    assert balance_white(lab, np.ones(lab.shape[:2], bool)) is lab
    pale = lab_from_rgb(painted(*SHEET, light=(1.0, 0.9, 0.8)))
    assert balance_white(pale, np.zeros(pale.shape[:2], bool)) is pale


def test_white_balance_removes_a_limited_cast_and_does_not_touch_its_input() -> None:
    lab = lab_from_rgb(painted(((235, 205, 175), 60)))
    kept = lab.copy()
    balanced = balance_white(lab, np.ones(lab.shape[:2], bool))
    np.testing.assert_array_equal(lab, kept)
    shift = np.linalg.norm((balanced - lab)[..., 1:], axis=2) / lab[..., 0]
    assert shift.max() <= MAX_CAST + 1e-4
    assert shift.max() > 0.05


@pytest.mark.parametrize("name", ["red", "orange", "yellow", "green", "blue", "purple", "pink", "white"])
def test_shading_does_not_change_the_name(name: str) -> None:
    """A round thing: the same paint between full light and a third of it."""
    rgb = np.array(NAMED[name][0], float)
    linear = np.where(rgb / 255 <= 0.04045, rgb / 255 / 12.92, ((rgb / 255 + 0.055) / 1.055) ** 2.4)
    lit = linear * np.linspace(0.35, 0.9, 400)[:, None]
    srgb = np.where(lit <= 0.0031308, 12.92 * lit, 1.055 * lit ** (1 / 2.4) - 0.055)
    colors = name_colors(lab_from_rgb(np.rint(srgb * 255).astype(np.uint8)))
    assert colors[0][0] == name
    assert colors[0][1] > 0.6


def test_shares_are_those_of_the_pixels() -> None:
    lab = lab_from_rgb(np.repeat(np.array([(186, 34, 36), (40, 90, 190)], np.uint8), [300, 100], axis=0))
    colors = dict(name_colors(lab))
    assert colors["red"] == pytest.approx(0.75, abs=0.06)
    assert colors["blue"] == pytest.approx(0.25, abs=0.06)
    assert list(colors.values()) == sorted(colors.values(), reverse=True)


def test_an_all_black_image_is_black() -> None:
    lab = lab_from_rgb(np.zeros((40, 40, 3), np.uint8))
    assert np.isfinite(lab).all()
    assert balance_white(lab, np.ones((40, 40), bool)) is lab
    assert name_colors(lab.reshape(-1, 3)) == (("black", 1.0),)
