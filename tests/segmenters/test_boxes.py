"""Boxes and masks, against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.segmenters.boxes import box_iou, clip_boxes, has_area, mask_box, mask_iou, segment_of, suppress


def boxes(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-10, 60, (n, 2, 2))
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1).astype(np.float32)


def one_iou(a: np.ndarray, b: np.ndarray) -> float:
    w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    both = max(w, 0) * max(h, 0)
    either = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both
    return both / either if either > 0 else 0.0


def test_clipped_boxes_lie_in_the_image():
    clipped = clip_boxes(boxes(50), (40, 50))
    assert clipped.dtype == np.float32
    assert (clipped >= 0).all()
    assert (clipped <= [50, 40, 50, 40]).all()
    outside = clip_boxes(np.array([[60, 1, 70, 9]], np.float32), (40, 50))
    assert not has_area(outside)[0]


@pytest.mark.parametrize(
    ("box", "shown"), [([0, 0, 1, 1], True), ([0, 0, 0.5, 9], False), ([3, 3, 2, 9], False), ([0, 0, np.nan, 9], False)]
)
def test_a_box_needs_area(box, shown):
    assert has_area(np.array([box], np.float32))[0] == shown


def test_overlap_is_that_of_the_definition():
    a, b = boxes(20), boxes(15, seed=1)
    expected = [[one_iou(p, q) for q in b] for p in a]
    np.testing.assert_allclose(box_iou(a, b), expected, atol=1e-6)
    assert box_iou(np.zeros((1, 4), np.float32), np.zeros((1, 4), np.float32))[0, 0] == 0


def test_suppression_keeps_the_best_of_what_overlaps():
    found, scores = boxes(60), np.random.default_rng(2).uniform(size=60).astype(np.float32)
    kept = suppress(found, scores, 0.4)
    assert list(scores[kept]) == sorted(scores[kept], reverse=True)
    overlaps = box_iou(found, found)
    for i in range(60):
        better = [k for k in kept if scores[k] >= scores[i] and k != i]
        assert (i in kept) == all(overlaps[i, k] <= 0.4 for k in better)


def test_equal_scores_keep_their_order():
    apart = np.array([[i * 10, 0, i * 10 + 5, 5] for i in range(4)], np.float32)
    assert suppress(apart, np.ones(4, np.float32), 0.5).tolist() == [0, 1, 2, 3]
    same = np.repeat(apart[:1], 3, axis=0)
    assert suppress(same, np.ones(3, np.float32), 0.5).tolist() == [0]
    assert suppress(same[:0], np.ones(0, np.float32), 0.5).tolist() == []


def test_a_segment_has_the_masks_box_and_says_whether_the_border_cuts_it():
    mask = np.zeros((20, 30), bool)
    mask[3:7, 5:11] = True
    assert mask_box(mask) == (5, 3, 11, 7)
    assert not segment_of(mask, "mug", 0.5).touches_border
    for row, column in ((0, 8), (19, 8), (5, 0), (5, 29)):
        cut = mask.copy()
        cut[row, column] = True
        assert segment_of(cut, "mug", 0.5).touches_border


def test_mask_overlap():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert mask_iou(a, b) == 0
    a[:2], b[1:3] = True, True
    assert mask_iou(a, b) == pytest.approx(1 / 3)
