from __future__ import annotations

import itertools

import numpy as np
import pytest

from thinkgrasp.errors import InputError
from thinkgrasp.motion.trajectory import CORNER_S, PERIOD_S, Trajectory, time_path
from thinkgrasp.motion.ur5e import LIMITS


def polyline(seed: int, corners: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (corners, 6))


def curve() -> np.ndarray:
    t = np.linspace(0, 1, 60)[:, None]
    return np.hstack([np.sin(3 * t), np.cos(4 * t), t, t * t, 0 * t, np.sin(7 * t)])


PATHS = {
    "one joint": np.array([[0.0] * 6, [2.0] + [0.0] * 5]),
    "all joints": np.array([[0.0] * 6, [2.0, -1, 0.5, 0.1, 0.01, 1.9]]),
    "hardly any": np.array([[0.0] * 6, [1e-5] + [0.0] * 5]),
    "there and back": np.array([[0.0] * 6, [1.0] + [0.0] * 5, [0.0] * 6]),
    "repeated points": polyline(0)[[0, 0, 1, 2, 2, 2, 3]],
    "curve": curve(),
    **{f"corners {seed}": polyline(seed) for seed in range(6)},
}


@pytest.fixture(params=list(PATHS), ids=lambda name: name.replace(" ", "-"))
def path(request: pytest.FixtureRequest) -> np.ndarray:
    return PATHS[request.param]


def rate(trajectory: Trajectory, order: int) -> np.ndarray:
    """Largest finite difference of this order per joint."""
    return np.abs(np.diff(trajectory.positions, order, axis=0)).max(axis=0) / PERIOD_S**order


@pytest.mark.parametrize("speed", [1.0, 0.2])
def test_limits_hold(path: np.ndarray, speed: float) -> None:
    motion = time_path(path, LIMITS, speed=speed)
    assert (rate(motion, 1) <= speed * LIMITS.velocity * 1.001).all()
    assert (rate(motion, 2) <= LIMITS.acceleration * 1.001).all()
    assert (rate(motion, 3) <= LIMITS.jerk * 1.001).all()


def test_starts_and_ends_at_rest_where_the_path_does(path: np.ndarray) -> None:
    motion = time_path(path, LIMITS)
    np.testing.assert_allclose(motion.start, path[0], atol=1e-12)
    np.testing.assert_allclose(motion.end, path[-1], atol=1e-12)
    for end in (motion.positions[:2], motion.positions[-2:]):
        assert np.abs(np.diff(end, axis=0)).max() / PERIOD_S < 0.02


def test_stays_near_the_path(path: np.ndarray) -> None:
    pieces = [a + (b - a) * np.linspace(0, 1, 400)[:, None] for a, b in itertools.pairwise(path)]
    dense = np.concatenate(pieces)
    away = [np.abs(dense - q).max(axis=1).min() for q in time_path(path, LIMITS).positions[::5]]
    acceleration, jerk = LIMITS.acceleration[0], LIMITS.jerk[0]
    assert max(away) < acceleration * (CORNER_S**2 / 8 + (acceleration / jerk) ** 2)


def test_a_long_straight_move_takes_little_more_than_the_trapezoid() -> None:
    motion = time_path(PATHS["one joint"], LIMITS)
    v, a = LIMITS.velocity[0], LIMITS.acceleration[0]
    assert 2.0 / v + v / a <= motion.duration_s < 2.0 / v + v / a + 0.12


def test_a_finely_sampled_line_takes_as_long_as_its_ends() -> None:
    ends = PATHS["all joints"]
    fine = ends[0] + np.linspace(0, 1, 50)[:, None] * (ends[1] - ends[0])
    assert time_path(fine, LIMITS).duration_s == pytest.approx(time_path(ends, LIMITS).duration_s, abs=0.02)


def test_sample_is_clipped_and_vectorised() -> None:
    motion = time_path(PATHS["one joint"], LIMITS)
    np.testing.assert_array_equal(motion.sample(-1.0), motion.start)
    np.testing.assert_allclose(motion.sample(motion.duration_s + 1), motion.end)
    np.testing.assert_allclose(motion.sample(motion.times_s), motion.positions, atol=1e-9)
    halfway = motion.sample((motion.times_s[10] + motion.times_s[11]) / 2)
    np.testing.assert_allclose(halfway, motion.positions[10:12].mean(axis=0))


def test_reversed_runs_backwards() -> None:
    motion = time_path(polyline(3), LIMITS)
    np.testing.assert_array_equal(motion.reversed().positions, motion.positions[::-1])
    assert motion.reversed().duration_s == motion.duration_s


def test_standing_still_takes_no_time() -> None:
    motion = time_path(np.zeros((3, 6)), LIMITS)
    assert motion.duration_s == 0
    np.testing.assert_array_equal(motion.sample(0.5), np.zeros(6))


@pytest.mark.parametrize(
    ("path", "speed", "message"),
    [
        (np.zeros((0, 6)), 1.0, "shape"),
        (np.zeros((2, 5)), 1.0, "shape"),
        (np.full((2, 6), np.nan), 1.0, "finite"),
        (np.zeros((2, 6)), 0.0, "speed"),
        (np.zeros((2, 6)), 1.1, "speed"),
    ],
)
def test_unusable_input_is_named(path: np.ndarray, speed: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        time_path(path, LIMITS, speed=speed)
