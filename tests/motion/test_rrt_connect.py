from __future__ import annotations

import itertools

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.motion.paths import PathBudget, PathQuery, edge_is_free, edge_points, shortcut
from thinkgrasp.motion.rrt_connect import rrt_connect


def wall(q: np.ndarray) -> np.ndarray:
    """A wall across the middle with a gap at either end."""
    return ~((np.abs(q[:, 0]) < 0.1) & (np.abs(q[:, 1]) < 0.8))


def query(free=wall, start=(-1.0, 0.0), goals=((1.0, 0.0),)) -> PathQuery:
    return PathQuery(free, np.array(start), np.array(goals), -np.ones(2), np.ones(2))


def assert_valid(path: np.ndarray | None, asked: PathQuery) -> np.ndarray:
    assert path is not None
    np.testing.assert_array_equal(path[0], asked.start)
    assert (np.abs(asked.goals - path[-1]).max(axis=1) == 0).any()
    for a, b in itertools.pairwise(path):
        blocked = ~asked.free(a + (b - a) * np.linspace(0, 1, 2001)[:, None])
        assert blocked.mean() * np.abs(b - a).max() < PathBudget().resolution_rad  # a corner may be cut by less
    return path


@pytest.mark.parametrize("seed", range(5))
def test_goes_around_the_wall(seed: int) -> None:
    path = assert_valid(rrt_connect(query(), np.random.default_rng(seed)), query())
    assert np.abs(path[:, 1]).max() >= 0.8
    assert len(path) <= 5


def test_same_seed_same_path() -> None:
    first, second = (rrt_connect(query(), np.random.default_rng(7)) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)


def test_a_free_line_is_taken_and_to_the_nearest_goal() -> None:
    asked = query(start=(0.5, 0.0), goals=((1.0, 0.9), (-1.0, 0.0), (0.9, 0.1)))
    path = rrt_connect(asked, np.random.default_rng(0))
    np.testing.assert_array_equal(path, [[0.5, 0.0], [0.9, 0.1]])


def test_any_goal_will_do() -> None:
    asked = query(goals=((0.0, 0.0), (5.0, 0.0), (0.9, 0.3)))  # in the wall, out of bounds, fine
    path = assert_valid(rrt_connect(asked, np.random.default_rng(0)), asked)
    np.testing.assert_array_equal(path[-1], [0.9, 0.3])


@pytest.mark.parametrize(
    "asked",
    [
        pytest.param(query(start=(0.0, 0.0)), id="start in collision"),
        pytest.param(query(goals=((0.0, 0.5),)), id="goal in collision"),
        pytest.param(query(goals=((3.0, 0.5),)), id="goal out of bounds"),
        pytest.param(query(free=lambda q: np.abs(q[:, 0]) > 0.1), id="closed wall"),
        pytest.param(query(goals=np.zeros((0, 2))), id="no goal"),
    ],
)
def test_no_path_is_none(asked: PathQuery) -> None:
    assert rrt_connect(asked, np.random.default_rng(0), PathBudget(max_checks=500)) is None


def test_gives_up_within_the_budget() -> None:
    asked = 0

    def closed(q: np.ndarray) -> np.ndarray:
        nonlocal asked
        asked += len(q)
        return np.abs(q[:, 0]) > 0.1

    assert rrt_connect(query(closed), np.random.default_rng(0), PathBudget(max_checks=800)) is None
    assert asked < 1000


def test_an_edge_is_looked_at_everywhere() -> None:
    a, b = np.zeros(2), np.array([0.97, 0.3])
    points = edge_points(a, b, 0.05)
    assert np.abs(np.diff(np.vstack([a, points]), axis=0)).max() <= 0.05 + 1e-12
    np.testing.assert_array_equal(points[-1], b)
    for blocked in points:
        assert not edge_is_free(lambda q, p=blocked: ~(np.abs(q - p).max(axis=1) < 1e-9), a, b, 0.05)


def test_shortcut_straightens() -> None:
    detour = np.array([[-1.0, 0.0], [-1.0, 0.95], [0.2, 0.9], [0.5, 0.9], [1.0, 0.9], [1.0, 0.0]])
    short = shortcut(wall, detour, np.random.default_rng(0), PathBudget())
    length = [np.abs(np.diff(p, axis=0)).max(axis=1).sum() for p in (detour, short)]
    assert length[1] < 0.8 * length[0]
    assert_valid(short, query())


def test_shapes_are_checked() -> None:
    with pytest.raises(InputError, match="start, lower and upper"):
        PathQuery(wall, np.zeros(2), np.zeros(2), -np.ones(2), np.ones(2))
    with pytest.raises(InputError, match="outside its bounds"):
        query(start=(2.0, 0.0))
    with pytest.raises(ConfigError, match="budget"):
        PathBudget(max_checks=0)
