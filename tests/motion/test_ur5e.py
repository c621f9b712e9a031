from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from thinkgrasp.errors import InputError
from thinkgrasp.motion.ur5e import LIMITS, forward, inverse, link_frames

angles = arrays(np.float64, 6, elements=st.floats(-np.pi, np.pi))


def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Difference of angles, without whole turns."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def test_zero_pose_is_the_makers() -> None:
    T = forward(np.zeros(6))
    np.testing.assert_allclose(T[:3, 3], [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_upright_pose_by_hand() -> None:
    """All links on one vertical line, but for the three offsets along y."""
    T = forward(np.array([0, -np.pi / 2, 0, -np.pi / 2, 0, 0]))
    np.testing.assert_allclose(T[:3, 3], [0, -0.1333 - 0.0996, 0.1625 + 0.425 + 0.3922 + 0.0997], atol=1e-12)


def test_links_keep_their_lengths() -> None:
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 6))
    origin = link_frames(q)[..., :3, 3]
    np.testing.assert_allclose(np.linalg.norm(origin[:, 1] - origin[:, 0], axis=-1), 0.425)
    np.testing.assert_allclose(np.linalg.norm(origin[:, 2] - origin[:, 1], axis=-1), 0.3922)
    np.testing.assert_allclose(np.linalg.norm(origin[:, 5] - origin[:, 4], axis=-1), 0.0996)


@given(angles)
def test_every_branch_puts_the_flange_there(q: np.ndarray) -> None:
    T = forward(q)
    found = inverse(T[None])[0]
    reached = np.isfinite(found).all(axis=1)
    assert reached.any()
    assert (np.abs(found[reached]) <= np.pi + 1e-12).all()
    np.testing.assert_allclose(forward(found[reached]), np.broadcast_to(T, (reached.sum(), 4, 4)), atol=1e-9)
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), ~reached)


def test_the_angles_are_among_the_branches() -> None:
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (2000, 6))
    error = turned(inverse(forward(q)), q[:, None]).max(axis=-1)
    assert np.nanmin(error, axis=1).max() < 1e-6


@pytest.mark.parametrize(
    "q",
    [
        pytest.param([0.3, -1.2, 1.0, -0.4, 0.0, 0.7], id="wrist straight"),
        pytest.param([0.3, -1.2, 1.0, -0.4, np.pi, 0.7], id="wrist folded"),
        pytest.param([0.3, -1.2, 0.0, -0.4, 0.9, 0.7], id="elbow stretched"),
        pytest.param([0.3, -1.2, np.pi, -0.4, 0.9, 0.7], id="elbow folded"),
        pytest.param([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0], id="all at once"),
    ],
)
def test_singular_poses_are_solved(q: list[float]) -> None:
    T = forward(np.array(q))
    found = inverse(T[None])[0]
    found = found[np.isfinite(found).all(axis=1)]
    assert len(found)
    np.testing.assert_allclose(forward(found), np.broadcast_to(T, (len(found), 4, 4)), atol=1e-9)


def test_out_of_reach_is_nan() -> None:
    far, inside_the_shoulder = np.eye(4), np.eye(4)
    far[:3, 3] = 1.5, 0, 0.2
    inside_the_shoulder[:3, 3] = 0.0, 0.0, 0.7  # wrist centre nearer to the axis of joint 1 than the arm is wide
    assert np.isnan(inverse(np.stack([far, inside_the_shoulder]))).all()


def test_a_branch_is_continuous_along_a_straight_line() -> None:
    q = np.array([np.pi, -1.5, 1.9, -1.9, -np.pi / 2, 0.3])
    T = np.repeat(forward(q)[None], 200, axis=0)
    T[:, :3, 3] += np.linspace(0, 1, 200)[:, None] * [0.0, 0.2, -0.1]
    steps = turned(inverse(T)[1:], inverse(T)[:-1])
    assert np.nanmax(steps) < 0.03


def test_no_transforms_no_angles() -> None:
    assert inverse(np.zeros((0, 4, 4))).shape == (0, 8, 6)


def test_wrong_shape_is_named() -> None:
    with pytest.raises(InputError, match=r"\(4, 4\)"):
        inverse(np.eye(4))


def test_limits_are_the_makers_or_tighter() -> None:
    assert (LIMITS.lower >= -2 * np.pi).all()
    assert (LIMITS.upper <= 2 * np.pi).all()
    assert LIMITS.upper[2] < np.pi
    np.testing.assert_allclose(LIMITS.velocity, np.pi)
