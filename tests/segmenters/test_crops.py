"""A closer look at a part of the scene."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.models import picture
from scipy import ndimage

from thinkgrasp.segmenters.boxes import segment_of
from thinkgrasp.segmenters.crops import cut_scene, put_back, sharpness, widened
from thinkgrasp.testing import sample_scene


@pytest.mark.parametrize(
    ("box", "share", "expected"),
    [
        ((10, 20, 30, 60), 0.1, (8, 16, 32, 64)),
        ((10, 20, 30, 60), 0.0, (10, 20, 30, 60)),
        ((0, 1, 99, 79), 0.5, (0, 0, 100, 80)),
    ],
)
def test_widened_boxes_stay_in_the_image(box, share, expected):
    assert widened(box, share, (80, 100)) == expected


@pytest.mark.parametrize("box", [(0, 0, 320, 240), (200, 150, 260, 200), (0, 0, 10, 8), (319, 239, 320, 240)])
def test_a_cut_scene_holds_what_lies_in_the_box(box):
    scene = sample_scene()
    cut = cut_scene(scene, box)
    x0, y0, x1, y1 = box
    np.testing.assert_array_equal(cut.frame.color, scene.frame.color[y0:y1, x0:x1])
    np.testing.assert_array_equal(cut.frame.depth, scene.frame.depth[y0:y1, x0:x1])
    np.testing.assert_array_equal(cut.points, scene.points[y0:y1, x0:x1])
    assert cut.proposals == ()
    assert (cut.frame.camera.width, cut.frame.camera.height) == (x1 - x0, y1 - y0)


def test_what_was_found_is_put_back_where_it_was():
    mask = np.zeros((8, 10), bool)
    mask[2:4, 3:9] = True
    back = put_back(segment_of(mask, "handle", 0.7), (20, 30, 30, 38), (48, 64))
    assert (back.label, back.score, back.box_xyxy) == ("handle", 0.7, (23, 32, 29, 34))
    assert back.mask.shape == (48, 64)
    assert back.mask.sum() == mask.sum()
    assert not back.touches_border


def test_blur_makes_an_image_less_sharp():
    image = picture(640, 480)
    values = [sharpness(image)]
    for sigma in (0.7, 1.0, 2.0, 4.0):
        values.append(sharpness(ndimage.gaussian_filter(image.astype(np.float32), (sigma, sigma, 0)).astype(np.uint8)))
    assert values == sorted(values, reverse=True)
    assert values[0] > 100
    assert values[-1] < 5
    assert sharpness(np.full((50, 50, 3), 90, np.uint8)) < 1e-6
