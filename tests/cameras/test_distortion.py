from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.cameras.distortion import MODELS, Lens, Rectifier
from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

CAMERA = CameraIntrinsics(160, 120, 130.0, 130.0, 79.5, 59.5)
BENT = (-0.12, 0.05, 0.002, -0.003, 0.01)


def test_without_distortion_nothing_is_touched():
    rectifier = Rectifier(CAMERA, Lens())
    color, depth = np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32)
    assert rectifier.color(color) is color
    assert rectifier.depth(depth) is depth
    assert Lens("brown_conrady").is_pinhole, "all coefficients are zero"


def test_brown_conrady_is_opencvs_model():
    cv2 = pytest.importorskip("cv2", reason="needs thinkgrasp[calibration]")
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    points = np.concatenate([rays, np.ones((50, 1))], axis=1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(BENT))
    np.testing.assert_allclose(Lens("brown_conrady", BENT).distort(rays), expected[:, 0], atol=1e-12)


@pytest.mark.parametrize("model", MODELS[1:])
def test_straight_lines_become_straight(model):
    """A picture as the lens bends it: lines of constant x/z; rectified, each is one column again."""
    lens = Lens(model, BENT)
    v, u = np.mgrid[0:120, 0:160].astype(float)
    # Where a pixel of the bent picture looks: the inverse of the lens, by iteration.
    seen = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy], axis=-1)
    ideal = seen.copy()
    for _ in range(30):
        ideal += seen - lens.distort(ideal)
    bent = np.repeat((127 + 200 * ideal[..., :1]).astype(np.uint8), 3, axis=2)
    flat = Rectifier(CAMERA, lens).color(bent)
    expected = 127 + 200 * (u - CAMERA.cx) / CAMERA.fx
    inside = (flat[..., 0] > 0) & (np.abs(v - 60) < 45) & (np.abs(u - 80) < 60)
    assert np.abs(flat[..., 0].astype(float) - expected)[inside].max() < 2.5
    assert np.abs(bent[..., 0].astype(float) - expected)[inside].max() > 3


def test_depth_is_not_mixed():
    depth = np.where(np.arange(160) < 80, np.float32(0.5), np.float32(1.0))[None].repeat(120, axis=0)
    flat = Rectifier(CAMERA, Lens("brown_conrady", BENT)).depth(depth)
    assert set(np.unique(flat)) <= {0.0, 0.5, 1.0}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lens("ftheta", BENT), "'ftheta' is not supported; allowed are none, brown_conrady"),
        (lambda: Lens("brown_conrady", (0.1,)), "five finite coefficients"),
        (lambda: Lens("brown_conrady", (np.nan, 0, 0, 0, 0)), "five finite coefficients"),
    ],
)
def test_lenses_that_are_none(make, message):
    with pytest.raises(InputError, match=message):
        make()
