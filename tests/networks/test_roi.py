"""RoIAlign and the level of a box."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden  # noqa: E402

from thinkgrasp.networks import roi  # noqa: E402


@pytest.fixture(params=["as on the CPU", "as on a GPU"], autouse=True)
def blocks(request, monkeypatch):
    if request.param == "as on a GPU":
        monkeypatch.setattr(roi, "_blocks_alike", roi._blocks_of_any)


@pytest.mark.parametrize(
    ("key", "factor", "scale", "size", "ratio"),
    [
        ("roi/out7_adaptive", 1, 1 / 4, 7, None),
        ("roi/out7_sr2", 1, 1 / 4, 7, 2),
        ("roi/out2_scale32", 8, 1 / 32, 2, None),
    ],
)
def test_roi_align_is_the_originals(key, factor, scale, size, ratio):
    g = golden("golden_ops")
    features, rois = torch.from_numpy(g["roi/feat"]), torch.from_numpy(g["roi/rois"])
    for image in range(len(features)):
        rows = rois[:, 0] == image
        got = roi.roi_align(
            features[image : image + 1], rois[rows, 1:] * factor, scale=scale, size=size, sampling_ratio=ratio
        )
        np.testing.assert_allclose(got, g[key][rows.numpy()], atol=1e-5)


def test_pooling_over_levels_is_the_originals():
    g = golden("golden_ops")
    maps = [torch.from_numpy(g[f"pooler/p{i}"]).float() for i in range(2, 6)]
    boxes = torch.from_numpy(g["pooler/boxes"])
    levels = roi.assign_levels(boxes, 2, 5)
    np.testing.assert_array_equal(levels - 2, g["pooler/levels"])
    np.testing.assert_allclose(roi.pool(maps, boxes, levels, first=2, size=7), g["pooler/out"], atol=1e-4)


def test_levels_are_the_originals():
    g = golden("golden_ops")
    np.testing.assert_array_equal(roi.assign_levels(torch.from_numpy(g["levels/boxes"]), 2, 5) - 2, g["levels/out"])


def test_levels_by_size():
    sides = torch.tensor([0.0, 50, 111, 112, 223, 224, 448, 2000])
    boxes = torch.stack([sides * 0, sides * 0, sides, sides], dim=1)
    assert roi.assign_levels(boxes, 2, 5).tolist() == [2, 2, 2, 3, 3, 4, 5, 5]


def by_definition(features: torch.Tensor, box: list[float], scale: float, size: int) -> np.ndarray:
    """Sample by sample, in double precision."""
    c, height, width = features.shape
    data = features.double().numpy()
    x0, y0, x1, y1 = (v * scale - 0.5 for v in box)
    gx, gy = int(np.ceil((x1 - x0) / size)), int(np.ceil((y1 - y0) / size))
    out = np.zeros((c, size, size))
    for i, j, p, q in np.ndindex(size, size, gy, gx):
        y = y0 + (y1 - y0) / size * (i + (p + 0.5) / gy)
        x = x0 + (x1 - x0) / size * (j + (q + 0.5) / gx)
        if y < -1 or y > height or x < -1 or x > width:
            continue
        y, x = min(max(y, 0), height - 1), min(max(x, 0), width - 1)
        yl, xl = int(y), int(x)
        yh, xh = min(yl + 1, height - 1), min(xl + 1, width - 1)
        ly, lx = y - yl, x - xl
        out[:, i, j] += (1 - ly) * ((1 - lx) * data[:, yl, xl] + lx * data[:, yl, xh])
        out[:, i, j] += ly * ((1 - lx) * data[:, yh, xl] + lx * data[:, yh, xh])
    return out / max(gx * gy, 1)


@pytest.mark.parametrize(
    "box",
    [
        [3.3, 2.1, 29.7, 40.2],
        [-11.0, -9.5, 20.0, 60.0],
        [40.0, 30.0, 90.0, 70.0],
        [-20.0, -20.0, 80.0, 70.0],
        [10.0, 5.0, 10.5, 44.0],
        [5, 5, 5.2, 5.3],
    ],
)
def test_roi_align_is_the_definition(box):
    features = torch.randn(1, 3, 13, 17, generator=torch.Generator().manual_seed(0))
    got = roi.roi_align(features, torch.tensor([box]), scale=0.25, size=7)[0]
    np.testing.assert_allclose(got, by_definition(features[0], box, 0.25, 7), atol=2e-6)


def test_a_box_without_area_pools_zeros():
    boxes = torch.tensor([[5.0, 5, 5, 30], [5, 5, 5, 5], [8, 8, 20, 20]])
    pooled = roi.roi_align(torch.ones(1, 2, 13, 17), boxes, scale=0.25, size=7)
    assert pooled.flatten(1).amax(dim=1).tolist() == [0, 0, 1]


def test_many_boxes_in_chunks_are_the_same(monkeypatch):
    features = torch.randn(1, 3, 13, 17, generator=torch.Generator().manual_seed(0))
    boxes = torch.tensor([[i, i / 2, i + 25.0, 30 + i / 3] for i in range(20)])
    whole = roi.roi_align(features, boxes, scale=0.25, size=7)
    monkeypatch.setattr(roi, "MAX_ENTRIES", 300)
    torch.testing.assert_close(roi.roi_align(features, boxes, scale=0.25, size=7), whole)
