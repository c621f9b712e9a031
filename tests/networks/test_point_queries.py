"""Point operators, held against the official kernels' results and against literal translations of their rules."""

from __future__ import annotations

import re

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from fakes.grasp_networks import GOLDEN, golden, table_cloud  # noqa: E402

from thinkgrasp.errors import InputError  # noqa: E402
from thinkgrasp.networks import point_queries  # noqa: E402
from thinkgrasp.networks.point_queries import ball_query, cylinder_query, furthest_points, three_nearest  # noqa: E402

needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"no golden data at {GOLDEN}")
CASES = [k for k in golden("ops") if re.match(r"fps/.*/inds|query/(ball|cylinder)_", k)] if GOLDEN.is_dir() else []
F32 = np.float32


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_indices_are_those_of_the_official_kernels(case):
    data = golden("ops")
    numbers = [float(n) for n in case.split("_")[1:] if re.fullmatch(r"-?[\d.]+", n)]
    if case.startswith("fps"):
        found, _ = furthest_points(tensor(data[case.replace("inds", "xyz")]), len(data[case]))
    elif "ball" in case:
        radius, count = numbers
        found = ball_query(tensor(data["query/xyz"]), tensor(data["query/new_xyz"]), radius, int(count))
    else:
        radius, low, high, count = numbers
        rotations = tensor(data["query/rot"]).view(-1, 3, 3)
        cloud, centers = tensor(data["query/xyz"]), tensor(data["query/new_xyz"])
        found = cylinder_query(cloud, centers, rotations, radius, low, [high], int(count))[0]
    assert np.array_equal(found.numpy(), data[case])


@needs_golden
def test_three_nearest_are_those_of_the_official_kernel():
    data = golden("ops")
    squared, index = three_nearest(tensor(data["three_nn/unknown"]), tensor(data["three_nn/known"]))
    assert np.array_equal(index.numpy(), data["three_nn/idx"])
    assert np.array_equal(squared.numpy(), data["three_nn/dist2"])


def fps_as_threads(points: np.ndarray, count: int) -> list[int]:
    """The kernel, thread by thread."""
    n = len(points)
    threads = min(512, 2 ** int(np.log2(n)))
    far = np.full(n, 1e10, F32)
    squares = points[:, 0] ** 2 + points[:, 1] ** 2 + points[:, 2] ** 2
    picked = [0]
    for _ in range(count - 1):
        d = (points - points[picked[-1]]).astype(F32) ** 2
        near = (d[:, 0] + d[:, 1]) + d[:, 2]
        best = [(F32(-1), 0)] * threads
        for k in range(n):
            if squares[k] > 1e-3:
                far[k] = min(far[k], near[k])
                if far[k] > best[k % threads][0]:
                    best[k % threads] = (far[k], k)
        half = threads // 2
        while half:
            best = [max(best[t], best[t + half], key=lambda b: b[0]) for t in range(half)]
            half //= 2
        picked.append(best[0][1])
    return picked


@pytest.mark.parametrize(
    ("case", "points"),
    [
        ("grid", np.stack(np.meshgrid(*[np.arange(4) * 0.05 + 0.1] * 3), -1).reshape(-1, 3)),
        ("duplicates", np.repeat(np.random.default_rng(0).uniform(0.1, 0.4, (9, 3)), 5, axis=0)),
        ("about the origin", np.random.default_rng(1).uniform(-0.05, 0.05, (70, 3))),
        ("one", np.array([[0.2, 0.1, 0.5]])),
        ("two", np.array([[0.2, 0.1, 0.5], [0.2, 0.1, 0.6]])),
        ("random", np.random.default_rng(2).uniform(0.1, 0.4, (600, 3))),
        ("slabs", np.random.default_rng(3).normal(0.5, (0.02, 0.4, 0.02), (2000, 3))),
        ("pairs", np.repeat(np.random.default_rng(4).uniform(0.1, 0.9, (300, 3)), 2, axis=0)[::-1]),
    ],
)
def test_furthest_points_follow_the_kernel(case, points):
    points = points.astype(F32)
    index, unique = furthest_points(tensor(points), 40)
    picked = index.tolist()
    assert picked == fps_as_threads(points, 40)
    assert unique == (case in ("about the origin", "random", "slabs"))
    if unique:
        assert fps_as_threads(points[picked], 30) == list(range(30))
    squared = torch.from_numpy((points.astype(F32) ** 2).sum(axis=1))
    order = point_queries._tie_order(len(points), torch.device("cpu"))
    order = order[squared[order] > 1e-3]
    if len(order):
        found, in_order = point_queries._picks_on_device(tensor(points), order, 40)
        assert found.tolist() == picked
        assert in_order == (case in ("about the origin", "random", "slabs", "pairs"))
        assert in_order == (fps_as_threads(points[picked], 40) == list(range(40)))


def test_points_about_the_origin_alone_pick_the_first():
    assert furthest_points(torch.full((5, 3), 0.001), 4)[0].tolist() == [0, 0, 0, 0]


def first_hits(hit: np.ndarray, count: int) -> np.ndarray:
    out = np.zeros((len(hit), count), int)
    for row, found in zip(out, map(np.flatnonzero, hit), strict=True):
        row[: len(found)] = found[:count]
        row[len(found) :] = found[0] if len(found) else 0
    return out


CLOUDS = {
    "table": table_cloud(5000),
    "far away": table_cloud(3000) + F32(50),
    "wide": np.random.default_rng(0).uniform(-20, 20, (4000, 3)).astype(F32),
    "one spot": np.full((3000, 3), 0.4, F32),
    "one point": np.full((1, 3), 0.4, F32),
    "on the limit": (np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3), -1).reshape(-1, 3) / 64).astype(F32),
}


def scan_all(points, centers, reach, *rest):
    return point_queries._scan_all(points, centers, *rest)


@pytest.mark.parametrize("as_on_a_gpu", [False, True])
@pytest.mark.parametrize("name", CLOUDS)
def test_queries_equal_a_direct_search(name, as_on_a_gpu, monkeypatch):
    cloud = CLOUDS[name]
    rng = np.random.default_rng(0)
    centers = np.concatenate([cloud[rng.integers(0, len(cloud), 60)], cloud[:1] + F32(5)])
    if as_on_a_gpu:
        monkeypatch.setattr(point_queries, "_scan_near", scan_all)
        monkeypatch.setattr(point_queries, "_PAIRS_PER_BLOCK", 7 * len(cloud))
    d = cloud[None] - centers[:, None]
    squared = (d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1]) + d[..., 2] * d[..., 2]
    for radius, count in ((0.0625, 64), (0.125, 7)):
        found = ball_query(tensor(cloud), tensor(centers), radius, count).numpy()
        assert np.array_equal(found, first_hits(squared < F32(radius) * F32(radius), count))
    R = np.linalg.qr(rng.normal(size=(len(centers), 3, 3)))[0].astype(F32)
    x, y, z = (
        (R[:, None, 1, i] * d[..., 1] + R[:, None, 0, i] * d[..., 0]) + R[:, None, 2, i] * d[..., 2] for i in range(3)
    )
    beside = (y * y + z * z < F32(0.05) * F32(0.05)) & (x > F32(-0.02))
    found = cylinder_query(tensor(cloud), tensor(centers), tensor(R), 0.05, -0.02, [0.01, 0.04], 16).numpy()
    for layer, high in zip(found, (0.01, 0.04), strict=True):
        assert np.array_equal(layer, first_hits(beside & (x < F32(high)), 16))


def test_three_nearest_take_the_lower_index_of_equals():
    known = tensor(np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 3.0]]))
    squared, index = three_nearest(torch.zeros(1, 3), known)
    assert index.tolist() == [[0, 1, 2]]
    assert squared.tolist() == [[1, 1, 1]]


def test_no_points_are_refused():
    with pytest.raises(InputError, match="at least one point"):
        furthest_points(torch.zeros(0, 3), 3)
    with pytest.raises(InputError, match="at least one point"):
        ball_query(torch.zeros(0, 3), torch.zeros(2, 3), 0.1, 4)
    with pytest.raises(InputError, match="at least three known points"):
        three_nearest(torch.zeros(4, 3), torch.zeros(2, 3))
    assert ball_query(torch.ones(5, 3), torch.zeros(0, 3), 0.1, 4).shape == (0, 4)
