from __future__ import annotations

import sys

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.motion.ompl_planner import PLANNERS, OmplPlanner
from thinkgrasp.motion.paths import PathBudget, PathQuery


def wall(q: np.ndarray) -> np.ndarray:
    return ~((np.abs(q[:, 0]) < 0.1) & (np.abs(q[:, 1]) < 0.8))


QUERY = PathQuery(wall, np.array([-1.0, 0.0]), np.array([[1.0, 0.0], [0.9, 0.1]]), -np.ones(2), np.ones(2))
BUDGET = PathBudget(max_checks=4000)


@pytest.mark.parametrize("name", PLANNERS)
def test_goes_around_the_wall(name: str) -> None:
    pytest.importorskip("ompl", reason="needs the ompl extra")
    path = OmplPlanner(name)(QUERY, np.random.default_rng(2), BUDGET)
    assert path is not None
    np.testing.assert_array_equal(path[0], QUERY.start)
    assert (path[-1] == QUERY.goals).all(axis=1).any()
    assert np.abs(path[:, 1]).max() > 0.75


def test_same_seed_same_path() -> None:
    pytest.importorskip("ompl", reason="needs the ompl extra")
    planner = OmplPlanner("RRTConnect")
    first = planner(QUERY, np.random.default_rng(3), BUDGET)
    planner(QUERY, np.random.default_rng(4), BUDGET)
    second = planner(QUERY, np.random.default_rng(3), BUDGET)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)


def test_no_path_is_none() -> None:
    pytest.importorskip("ompl", reason="needs the ompl extra")
    closed = PathQuery(lambda q: np.abs(q[:, 0]) > 0.1, QUERY.start, QUERY.goals, QUERY.lower, QUERY.upper)
    blocked = PathQuery(wall, QUERY.start, np.zeros((1, 2)), QUERY.lower, QUERY.upper)
    for query in (closed, blocked):
        assert OmplPlanner("RRTstar")(query, np.random.default_rng(0), PathBudget(max_checks=500)) is None


def test_unknown_planner_lists_those_there_are() -> None:
    with pytest.raises(ConfigError, match="RRTstar, RRTConnect"):
        OmplPlanner("RRTT")


def test_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(MissingDependency, match=r"pip install 'thinkgrasp\[ompl\]'"):
        OmplPlanner()
