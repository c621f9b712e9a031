"""Patches: connected, exactly covering the mask, and kept to one surface and one colour."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.surfaces import WIDTH, Sheet, cylinder, pixels, plane, sheet, two_colors
from scipy import ndimage

from thinkgrasp.perception.morphology import Labels
from thinkgrasp.perception.superpixels import superpixels
from thinkgrasp.types import Mask

LEFT = pixels(lambda u, v: u < WIDTH // 2 + 3)
RING = pixels(lambda u, v: (np.hypot(u - 80, v - 70) < 60) & (np.hypot(u - 80, v - 70) > 30))
DUST = pixels(lambda u, v: (u * 7 + v * 13) % 11 < 4)


def flat(mask: Mask) -> Sheet:
    return sheet(*plane((0, -1, -1), (0, 0, 0.6)), mask)


def round_one() -> Sheet:
    points, normals, mask = cylinder(0.06, 0.5)
    return sheet(points, normals, mask)


def cut(s: Sheet) -> Labels:
    return superpixels(s.mask, s.points, s.normals, s.lab)


@pytest.mark.parametrize(
    "surface",
    [flat(np.ones_like(LEFT)), flat(RING), flat(DUST), round_one()],
    ids=["whole view", "ring", "dust", "cylinder"],
)
def test_patches_cover_the_mask_exactly_and_are_connected(surface: Sheet) -> None:
    labels = cut(surface)
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(labels > 0, surface.mask)
    n = labels.max()
    np.testing.assert_array_equal(np.unique(labels[surface.mask]), np.arange(1, n + 1))
    for i, box in enumerate(ndimage.find_objects(labels), start=1):
        assert ndimage.label(labels[box] == i)[1] == 1


def test_patches_have_about_the_size_asked_for() -> None:
    labels = cut(flat(np.ones_like(LEFT)))
    area = np.bincount(labels.ravel())[1:]
    assert 0.5 < np.median(area) / 100 < 2
    assert area.max() < 500


def purity(labels: Labels, side: Mask) -> float:
    """Return the share of pixels that lie in a patch whose majority is on their own side."""
    n = labels.max() + 1
    on, off = np.bincount(labels[side], minlength=n), np.bincount(labels[~side], minlength=n)
    return float(np.maximum(on, off)[1:].sum() / (on + off)[1:].sum())


def test_patches_keep_to_one_colour() -> None:
    points, normals = plane((0, 0, 1), (0, 0, 0.6))
    surface = sheet(points, normals, np.ones_like(LEFT), two_colors(LEFT, (186, 34, 36), (40, 90, 190)))
    assert purity(cut(surface), LEFT) > 0.995


def test_patches_keep_to_one_side_of_a_depth_step() -> None:
    points, normals = plane((0, 0, 1), (0, 0, 1.0))
    z = np.where(LEFT, np.float32(0.6), np.float32(0.66))
    surface = sheet(points * z[..., None], normals, np.ones_like(LEFT))
    assert purity(cut(surface), LEFT) > 0.99


def test_unknown_normals_do_not_lose_pixels() -> None:
    points, normals = plane((0, 0, 1), (0, 0, 0.6))
    normals = np.where(RING[..., None], np.float32(np.nan), normals)
    surface = sheet(points, normals, np.ones_like(LEFT))
    assert (cut(surface) > 0).all()


def test_an_empty_mask_has_no_patches() -> None:
    labels = cut(flat(np.zeros_like(LEFT)))
    assert labels.shape == LEFT.shape
    assert not labels.any()
