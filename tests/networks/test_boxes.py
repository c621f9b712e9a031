"""Boxes: decoding, clipping, overlaps; against golden data of the original code and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden  # noqa: E402

from thinkgrasp.networks import boxes as bx  # noqa: E402


def t(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array))


@pytest.mark.parametrize("name", ["rpn", "s0", "s1", "s2"])
def test_decode_is_the_originals(name):
    g = golden("golden_ops")
    got = bx.decode(t(g[f"decode/{name}_deltas"]), t(g[f"decode/{name}_boxes"]), g[f"decode/{name}_weights"].tolist())
    np.testing.assert_allclose(got, g[f"decode/{name}_out"], rtol=1e-5, atol=1e-4)


def test_a_decoded_side_grows_by_a_limited_factor_and_shrinks_without_limit():
    box = torch.tensor([[0.0, 0.0, 16.0, 16.0]])
    grown = bx.decode(torch.tensor([[0.0, 0.0, 99.0, -30.0]]), box, (1, 1, 1, 1))[0]
    assert (grown[2] - grown[0]).item() == pytest.approx(16 * 1000 / 16)
    assert (grown[3] - grown[1]).item() == pytest.approx(16 * math.exp(-30), abs=1e-6)


def test_clip_is_the_originals():
    g = golden("golden_ops")
    got = bx.clip(t(g["clip/in"]), tuple(g["clip/hw"].tolist()))
    np.testing.assert_array_equal(got, g["clip/out"])
    np.testing.assert_array_equal(bx.has_area(got), g["clip/nonempty"])


@pytest.mark.parametrize(
    ("size", "key", "threshold"),
    [
        ("tie", "bkeep_05", 0.5),
        ("tie", "bkeep_07", 0.7),
        ("small", "keep_05", 0.5),
        ("small", "keep_07", 0.7),
        ("large", "keep_05", 0.5),
        ("large", "keep_07", 0.7),
    ],
)
def test_nms_by_group_is_the_originals(size, key, threshold):
    g = golden("golden_ops")
    boxes, scores, groups = (t(g[f"nms/{size}_{part}"]) for part in ("boxes", "scores", "groups"))
    np.testing.assert_array_equal(bx.grouped_nms(boxes, scores, groups, threshold), g[f"nms/{size}_{key}"])


def test_nms_without_groups_is_the_originals():
    g = golden("golden_ops")
    np.testing.assert_array_equal(bx.nms(t(g["nms/tie_boxes"]), t(g["nms/tie_scores"]), 0.5), g["nms/tie_keep_05"])


def test_the_first_kept_are_the_same_with_a_limit():
    g = golden("golden_ops")
    boxes, scores, groups = (t(g[f"nms/large_{part}"]) for part in ("boxes", "scores", "groups"))
    for limit in (1, 100, 300):
        whole = bx.grouped_nms(boxes, scores, groups, 0.7)[:limit]
        assert torch.equal(bx.grouped_nms(boxes, scores, groups, 0.7, limit=limit), whole)


def test_nms_in_blocks_is_nms_at_once(monkeypatch):
    rng = torch.Generator().manual_seed(3)
    corner = torch.rand(200, 2, generator=rng) * 60
    boxes = torch.cat([corner, corner + 5 + torch.rand(200, 2, generator=rng) * 30], dim=1)
    scores = torch.rand(200, generator=rng)
    whole = bx.nms(boxes, scores, 0.3)
    monkeypatch.setattr(bx, "NMS_BLOCK", 7)
    assert torch.equal(bx.nms(boxes, scores, 0.3), whole)


def test_boxes_without_area_neither_remove_nor_are_removed():
    boxes = torch.tensor([[1.0, 1, 1, 1], [1, 1, 1, 1], [0, 0, 4, 4], [0, 0, 4, 4]])
    assert bx.nms(boxes, torch.tensor([0.9, 0.8, 0.7, 0.6]), 0.5).tolist() == [0, 1, 2]


def test_an_overlap_at_the_threshold_stays_and_ties_keep_their_order():
    boxes = torch.tensor([[0.0, 0, 2, 1], [0, 0, 1, 1]])
    assert bx.nms(boxes, torch.tensor([0.5, 0.5]), 0.5).tolist() == [0, 1]
    assert bx.nms(boxes, torch.tensor([0.5, 0.5]), 0.49).tolist() == [0]


def test_nothing_in_nothing_out():
    empty = torch.empty(0)
    assert bx.nms(torch.empty(0, 4), empty, 0.5).tolist() == []
    assert bx.grouped_nms(torch.empty(0, 4), empty, empty.long(), 0.5).tolist() == []
