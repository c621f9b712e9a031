from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.motion.limits import JointLimits


def limits(lower: float = -4.0, upper: float = 4.0, rate: float = 1.0) -> JointLimits:
    return JointLimits(np.full(2, lower), np.full(2, upper), np.full(2, rate), np.full(2, 2.0), np.full(2, 3.0))


def test_contain_is_inclusive_and_false_for_nan() -> None:
    q = np.array([[4.0, -4.0], [4.1, 0.0], [np.nan, 0.0]])
    np.testing.assert_array_equal(limits().contain(q), [True, False, False])


def test_nearest_turn_within_range() -> None:
    turn = 2 * np.pi
    np.testing.assert_allclose(limits().nearest_to(np.array([3.0, -3.5]), np.array([3.2 - turn, 3.0])), [3.2, 3 - turn])
    np.testing.assert_allclose(limits().nearest_to(np.array([30.0, 0.0]), np.array([3.2 - turn, 0.1])), [3.2, 0.1])


def test_no_equivalent_in_range_is_nan_in_all_joints() -> None:
    narrow = limits(-1.0, 1.0)
    q = narrow.nearest_to(np.zeros(2), np.array([[0.5, 2.0], [0.5, 0.5 + 2 * np.pi], [np.nan, 0.0]]))
    np.testing.assert_allclose(q, [[np.nan, np.nan], [0.5, 0.5], [np.nan, np.nan]])


@pytest.mark.parametrize("bad", [{"lower": 5.0}, {"rate": 0.0}, {"rate": np.inf}])
def test_impossible_limits_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="joint limits"):
        limits(**bad)


def test_lengths_must_agree() -> None:
    one, two = np.ones(1), np.ones(2)
    with pytest.raises(ConfigError, match="one value per joint"):
        JointLimits(-two, two, one, two, two)
