"""Numbered marks: inside their things, apart from each other, and the same on any background."""

from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.planners.marks import draw_marks, resized
from thinkgrasp.types import Mask, Proposal

W, H = 320, 240
V, U = np.mgrid[:H, :W]
WHITE = np.array([255, 255, 255])


def thing(mark: int, mask: Mask) -> Proposal:
    v, u = np.nonzero(mask)
    box = (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1)
    return Proposal(mark, mask, box, (0.1, 0.1, 0.1), np.eye(4), (0.0, 0.1), (), (), False, 0.9)


def disk(u: float, v: float, radius: float) -> Mask:
    return np.hypot(U - u, V - v) <= radius


def gray(value: int = 120) -> np.ndarray:
    return np.full((H, W, 3), value, np.uint8)


def plate(picture: np.ndarray) -> tuple[int, int, int, int]:
    """The box of the plate's white rim on a background without white."""
    v, u = np.nonzero((picture == WHITE).all(axis=2))
    return int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1


SHAPES = {
    "disk": disk(100, 100, 30),
    "ring": disk(160, 120, 60) & ~disk(160, 120, 40),
    "bar": (np.abs(V - 60) < 4) & (np.abs(U - 160) < 100),
    "diagonal": (np.abs(U - V) < 6) & (U > 40) & (U < 200),
    "two pieces": disk(60, 60, 20) | disk(200, 150, 30),
    "corner": (U < 40) & (V < 40),
}


@pytest.mark.parametrize("mask", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("scale", [0.5, 1, 2])
def test_the_plate_is_centred_in_the_mask(mask, scale):
    size = (round(W * scale), round(H * scale))
    x0, y0, x1, y1 = plate(draw_marks(gray(), [thing(7, mask)], size))
    assert mask[int((y0 + y1) / 2 / scale), int((x0 + x1) / 2 / scale)]


@pytest.mark.parametrize("mark", [1, 12, 123])
def test_numbers_look_the_same_on_any_background(mark):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 250, (H, W, 3), dtype=np.uint8)
    things = [thing(mark, disk(100, 100, 50))]
    x0, y0, x1, y1 = plate(draw_marks(gray(), things, (W, H)))
    plates = [draw_marks(image, things, (W, H))[y0:y1, x0:x1] for image in (gray(0), gray(255), noise)]
    assert all(np.array_equal(plates[0], other) for other in plates)
    assert (plates[0] == 0).all(axis=2).mean() > 0.2
    assert y1 - y0 >= 11


@pytest.mark.parametrize("value", [0, 255])
def test_outlines_show_on_black_and_on_white(value):
    picture = draw_marks(gray(value), [thing(1, disk(100, 100, 50))], (W, H)).astype(int)
    edge = np.abs(np.hypot(U - 100, V - 100) - 50) <= 2
    assert (np.abs(picture[edge] - value).sum(axis=1) > 300).mean() > 0.15


def test_plates_keep_apart_where_there_is_room():
    things = [thing(1, disk(100, 100, 40)), thing(2, disk(100, 100, 12)), thing(3, disk(108, 100, 12))]
    alone = [plate(draw_marks(gray(), [t], (W, H))) for t in things[1:]]
    assert alone[0][2] > alone[1][0]
    picture = draw_marks(gray(), things, (W, H))
    rims = (picture == WHITE).all(axis=2).sum()
    assert rims >= sum((draw_marks(gray(), [t], (W, H)) == WHITE).all(axis=2).sum() for t in things) * 0.99


def test_nothing_to_mark_leaves_the_picture():
    image = gray()
    assert np.array_equal(draw_marks(image, [], (W, H)), image)


def test_the_frame_is_not_changed_and_the_result_repeats():
    image = gray()
    things = [thing(i + 1, disk(40 + 30 * i, 60 + 15 * i, 18)) for i in range(8)]
    first = draw_marks(image, things, (W, H))
    assert np.array_equal(first, draw_marks(image, things, (W, H)))
    assert (image == 120).all()
    assert first.shape == (H, W, 3)
    assert first.dtype == np.uint8


@pytest.mark.parametrize("mask", [disk(0, 0, 1), disk(W - 1, H - 1, 1), V == 0, U == W - 1])
def test_thin_things_at_the_edge_have_their_whole_plate_in_the_picture(mask):
    x0, y0, x1, y1 = plate(draw_marks(gray(), [thing(42, mask)], (W, H)))
    assert x1 - x0 > 11
    assert y1 - y0 > 11


def test_an_empty_mask_is_no_error():
    empty = Proposal(1, np.zeros((H, W), bool), (0, 0, 1, 1), (0.1, 0.1, 0.1), np.eye(4), (0, 0.1), (), (), False, 0.9)
    assert draw_marks(gray(), [empty], (W, H)).shape == (H, W, 3)


@pytest.mark.parametrize("size", [(W, H), (224, 168), (640, 480), (1, 1)])
def test_resized(size):
    assert resized(gray(), size).shape == (size[1], size[0], 3)
