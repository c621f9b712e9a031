"""Anchors, and which proposals are kept."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden  # noqa: E402

from thinkgrasp.networks import proposals as rpn  # noqa: E402


def test_anchors_are_the_originals():
    g = golden("golden_ops")
    for level, size in zip(range(2, 7), (32, 64, 128, 256, 512), strict=True):
        np.testing.assert_array_equal(rpn.cell_anchors(size), g[f"anchors/cell_p{level}"])
    np.testing.assert_array_equal(rpn.grid_anchors((6, 7), 16, 128), g["anchors/grid_p4_6x7"])
    np.testing.assert_array_equal(rpn.grid_anchors((2, 2), 64, 512), g["anchors/grid_p6_2x2"])


def test_anchors_start_at_the_origin_wide_before_tall_row_by_row():
    cell = rpn.cell_anchors(32)
    sides = cell[:, 2:] - cell[:, :2]
    torch.testing.assert_close(sides[:, 1] / sides[:, 0], torch.tensor(rpn.RATIOS))
    grid = rpn.grid_anchors((2, 3), 4, 32).view(2, 3, 3, 4)
    centers = (grid[..., :2] + grid[..., 2:]) / 2
    assert centers[0, 0].abs().max() < 1e-5
    assert centers[1, 2, 0].tolist() == pytest.approx([8, 4])


def test_selection_is_the_originals():
    g = golden("golden_ops")
    levels = []
    for i in range(3):
        boxes, logits = torch.from_numpy(g[f"rpnsel/boxes{i}"]), torch.from_numpy(g[f"rpnsel/logits{i}"])
        best = torch.sort(logits, descending=True, stable=True).indices[:10]
        levels.append(rpn.Proposals(boxes[best], logits[best]))
    found = rpn.select(levels, (90, 110), threshold=0.7, limit=15)
    np.testing.assert_allclose(found.boxes, g["rpnsel/out_boxes"], atol=1e-4)
    np.testing.assert_array_equal(found.logits, g["rpnsel/out_logits"])


def test_levels_do_not_suppress_one_another():
    box = torch.tensor([[0.0, 0, 10, 10]])
    levels = [rpn.Proposals(box, torch.tensor([1.0])), rpn.Proposals(box, torch.tensor([2.0]))]
    assert rpn.select(levels, (20, 20), threshold=0.7, limit=9).logits.tolist() == [2.0, 1.0]


def test_what_is_not_finite_or_outside_is_dropped():
    boxes = torch.tensor([[0, 0, float("nan"), 3], [30, 30, 40, 40], [1, 1, 3, 3], [2, 2, 6, 6]])
    logits = torch.tensor([9.0, 8.0, 7.0, float("inf")])
    found = rpn.select([rpn.Proposals(boxes, logits)], (20, 20), threshold=0.7, limit=9)
    assert found.boxes.tolist() == [[1, 1, 3, 3]]
