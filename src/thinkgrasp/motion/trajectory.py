"""When to be where on a joint-space path: as fast as velocity, acceleration and jerk allow.

A path is a polyline. Along it the speed is the largest that the joints' limits allow (one pass forwards, one back).
The motion is then averaged over two short windows of time: the first turns the jump of velocity at each corner into a
bounded acceleration, the second the jumps of acceleration into a bounded jerk. Averaging never raises a bound, and it
leaves the path by no more than `acceleration * (CORNER_S**2 / 8 + (acceleration / jerk)**2)`, a few milliradians.

References:
    Bobrow, Dubowsky and Gibson 1985, time-optimal control along specified paths (the two passes).
    Biagiotti and Melchiorri 2012, FIR filter-based online jerk-constrained trajectory generation (the averaging).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.motion.limits import JointLimits

Float = NDArray[np.float64]

PERIOD_S = 0.004
"""Between two samples of a trajectory."""
CORNER_S = 0.06
"""Over which a change of direction is spread."""
_STEP_RAD = 0.02
_TOUCH_RAD = 1e-9
_STRAIGHT = 1e-4
_CENTRIPETAL_SHARE = 0.6
"""Of the acceleration limit, to turn; what is left, to speed up and brake while turning."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint positions over time, at rest at both ends."""

    times_s: Float
    """(T,) from 0, evenly spaced."""
    positions: Float
    """(T, n) [rad]."""

    @property
    def duration_s(self) -> float:
        """Time of the last sample."""
        return float(self.times_s[-1])

    @property
    def start(self) -> Float:
        """(n,) [rad]."""
        return self.positions[0]

    @property
    def end(self) -> Float:
        """(n,) [rad]."""
        return self.positions[-1]

    def sample(self, t: float | Float) -> Float:
        """Return the positions (n,) or, for times (K,), (K, n) [rad]; before and after, those of the ends."""
        last = len(self.times_s) - 1
        at = np.clip(np.asarray(t, np.float64) / PERIOD_S, 0, last)
        before = at.astype(np.intp)
        share = (at - before)[..., None]
        return self.positions[before] * (1 - share) + self.positions[np.minimum(before + 1, last)] * share

    def reversed(self) -> Trajectory:
        """Return the same motion run backwards."""
        return Trajectory(self.times_s, self.positions[::-1])


def time_path(path: NDArray[np.floating], limits: JointLimits, *, speed: float = 1.0) -> Trajectory:
    """Run along a polyline from rest to rest as fast as the limits allow.

    Args:
        path: (W, n) joint positions [rad], W >= 1.
        limits: Bounds on velocity, acceleration and jerk; ranges are not looked at.
        speed: Share of the velocity limit to use, 0..1.

    Raises:
        InputError: The path has another shape or is not finite, or the speed is out of range.
    """
    path = np.asarray(path, np.float64)
    if path.ndim != 2 or len(path) == 0 or path.shape[1:] != limits.velocity.shape or not np.isfinite(path).all():
        raise InputError(f"a path is finite and of shape (W, {len(limits.velocity)}), W >= 1; got shape {path.shape}")
    if not 0 < speed <= 1:
        raise InputError(f"speed is a share of the velocity limit and must lie in (0, 1], got {speed}")
    path = path[np.append(True, np.abs(np.diff(path, axis=0)).max(axis=1) > _TOUCH_RAD)]
    if len(path) < 2:
        return Trajectory(np.zeros(1), path.copy())
    slow = JointLimits(limits.lower, limits.upper, limits.velocity * speed, limits.acceleration, limits.jerk)
    smoothing_s = float((2 * limits.acceleration / limits.jerk).max())
    positions = _run(path, slow)
    for window_s in (CORNER_S, smoothing_s):
        positions = _average(positions, max(round(window_s / PERIOD_S), 1))
    return _stretch(positions, slow)


def _run(path: Float, limits: JointLimits) -> Float:
    """Sample a polyline (W, n), W >= 2, every PERIOD_S, as fast as the limits allow; corners stay sharp."""
    edge = np.diff(path, axis=0)
    edge_length = np.abs(edge).max(axis=1)
    direction = edge / edge_length[:, None]
    turn = np.maximum(np.abs(np.diff(direction, axis=0)), 1e-9)
    reach = (edge_length[:-1] + edge_length[1:])[:, None] / 2
    allowed = _CENTRIPETAL_SHARE * limits.acceleration / turn
    corner = np.concatenate([[0.0], np.minimum(allowed * CORNER_S, np.sqrt(allowed * reach)).min(axis=1), [0.0]])

    counts = np.ceil(edge_length / _STEP_RAD).astype(np.intp) + 1
    knots = np.concatenate([[0], np.cumsum(counts)])
    points = np.stack([np.interp(np.arange(knots[-1] + 1), knots, joint) for joint in path.T], axis=1)
    delta = np.diff(points, axis=0)
    length = np.abs(delta).max(axis=1)
    size = np.repeat(np.maximum(np.abs(direction), 1e-9), counts, axis=0)
    fastest = (limits.velocity / size).min(axis=1)
    bends = knots[1:-1][(turn > _STRAIGHT).any(axis=1)]
    near_bend = np.zeros(len(delta), bool)
    near_bend[np.clip(bends[:, None] + np.arange(-2, 2), 0, len(delta) - 1)] = True
    push = (limits.acceleration / size).min(axis=1) * np.where(near_bend, 1 - _CENTRIPETAL_SHARE, 1.0)

    v2 = np.concatenate([[0.0], np.minimum(fastest[:-1], fastest[1:]), [0.0]])
    v2[knots] = np.minimum(v2[knots], corner)
    speed = _passes(v2 * v2, 2 * push * length)

    # Between two points the acceleration is constant.
    took = 2 * length / (speed[:-1] + speed[1:])
    ends = np.concatenate([[0.0], np.cumsum(took)])
    t = np.linspace(0, ends[-1], int(np.ceil(ends[-1] / PERIOD_S)) + 1)
    i = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(took) - 1)
    since = t - ends[i]
    share = (speed[i] + (speed[i + 1] - speed[i]) / took[i] * since / 2) * since / length[i]
    return points[i] + np.clip(share, 0, 1)[:, None] * delta[i]


def _passes(square: Float, gain: Float) -> Float:
    """Return the speed (W,) below its given square bounds (W,) that changes by at most `gain` (W - 1,) in square."""
    bounds, gains = square.tolist(), gain.tolist()
    for i, g in enumerate(gains):
        bounds[i + 1] = min(bounds[i + 1], bounds[i] + g)
    for i in reversed(range(len(gains))):
        bounds[i] = min(bounds[i], bounds[i + 1] + gains[i])
    return np.sqrt(np.asarray(bounds))


def _average(positions: Float, window: int) -> Float:
    """Average (T, n) over `window` periods, resting at both ends: the result is `window` samples longer."""
    rest = np.repeat(positions[:1], window, axis=0), np.repeat(positions[-1:], window, axis=0)
    total = np.cumsum(np.concatenate([rest[0], positions, rest[1]]), axis=0)
    averaged = (total[window:] - total[:-window]) / window
    averaged[0], averaged[-1] = positions[0], positions[-1]
    return averaged


def _stretch(positions: Float, limits: JointLimits) -> Trajectory:
    """Turn samples into a trajectory, slowed down by as much as any limit is still exceeded."""
    rates = []
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), start=1):
        if len(positions) > order:
            rate = np.abs(np.diff(positions, order, axis=0)).max(axis=0) / PERIOD_S**order
            rates.append(float((rate / limit).max()) ** (1 / order))
    factor = max(rates, default=1.0)
    if factor > 1 + 1e-9:
        at = np.linspace(0, len(positions) - 1, int(np.ceil((len(positions) - 1) * factor)) + 1)
        positions = np.stack([np.interp(at, np.arange(len(positions)), joint) for joint in positions.T], axis=1)
    return Trajectory(np.arange(len(positions), dtype=np.float64) * PERIOD_S, positions)
