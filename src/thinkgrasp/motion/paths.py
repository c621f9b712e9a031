"""What every joint-space planner shares: how it is asked, and how an edge is checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError

Float = NDArray[np.float64]
Free = Callable[[Float], NDArray[np.bool_]]
"""Maps joint positions (M, n) to (M,) True where nothing collides."""

_DETOUR_RAD = 1.6
"""How far outside the box around start and goals a path may lead."""


@dataclass(frozen=True, eq=False)
class PathQuery:
    """From where to where, in which space.

    Raises:
        InputError: The arrays disagree in shape, or the start is outside the bounds.
    """

    free: Free
    start: Float
    """(n,) [rad]."""
    goals: Float
    """(G, n) [rad]; any of them will do."""
    lower: Float
    """(n,) [rad]."""
    upper: Float
    """(n,) [rad]."""

    def __post_init__(self) -> None:
        n = self.start.shape
        if len(n) != 1 or self.lower.shape != n or self.upper.shape != n or self.goals.shape[1:] != n:
            raise InputError(
                f"a path query needs start, lower and upper (n,) and goals (G, n); got {self.start.shape}, "
                f"{self.lower.shape}, {self.upper.shape} and {self.goals.shape}"
            )
        if not ((self.start >= self.lower - 1e-9) & (self.start <= self.upper + 1e-9)).all():
            raise InputError(f"the start of a path is outside its bounds: {np.round(self.start, 3).tolist()} rad")

    def region(self) -> tuple[Float, Float]:
        """Return the corners (n,) of the part of the space to search: around start and goals, within the bounds."""
        around = np.concatenate([self.start[None], self.goals])
        low, high = around.min(axis=0) - _DETOUR_RAD, around.max(axis=0) + _DETOUR_RAD
        return np.maximum(low, self.lower), np.minimum(high, self.upper)

    def clear_goals(self) -> Float:
        """Return the goals (K, n) that are within the bounds and free; none if the start itself is not."""
        goals = self.goals[((self.goals >= self.lower) & (self.goals <= self.upper)).all(axis=1)]
        if len(goals) == 0 or not self.free(self.start[None])[0]:
            return goals[:0]
        return goals[self.free(goals)]


@dataclass(frozen=True)
class PathBudget:
    """How finely to look and when to give up; counted, not timed, so that the same seed gives the same path.

    Raises:
        ConfigError: A number is not positive.
    """

    resolution_rad: float = 0.03
    """Largest step of any joint between two checks on an edge."""
    max_checks: int = 12_000
    """Configurations to check before giving up."""
    shortcuts: int = 60
    """Attempts to cut a corner of a path once found."""

    def __post_init__(self) -> None:
        if not (self.resolution_rad > 0 and self.max_checks > 0 and self.shortcuts >= 0):
            raise ConfigError(f"path budget: resolution and checks must be positive, shortcuts at least 0; got {self}")


class PathPlanner(Protocol):
    """Any planner here: a function from a query and a random generator to a path."""

    def __call__(self, query: PathQuery, rng: np.random.Generator, budget: PathBudget | None = ...) -> Float | None:
        """Return waypoints (W, n) [rad] from the start to a goal, the edges between them free; None if not found."""
        ...


def edge_points(a: Float, b: Float, resolution_rad: float) -> Float:
    """Return points (M, n) on the way from a to b, a left out and b included, no joint stepping farther than that."""
    m = max(int(np.ceil(np.abs(b - a).max() / resolution_rad)), 1)
    return a + (b - a) * (np.arange(1, m + 1) / m)[:, None]


def edge_is_free(free: Free, a: Float, b: Float, resolution_rad: float) -> bool:
    """Check an edge whose start is known to be free: far apart first, then in between, so that walls are met early."""
    points = edge_points(a, b, resolution_rad)
    for chunk in (points[7::8], points[3::8], points[1::4], points[::2]):
        if len(chunk) and not free(chunk).all():
            return False
    return True


def direct(query: PathQuery, budget: PathBudget) -> Float | None:
    """Return the straight line (2, n) to the first goal that has a free one, nearest first; None if there is none."""
    order = np.argsort(np.abs(query.goals - query.start).max(axis=1), kind="stable")
    for goal in query.goals[order]:
        if edge_is_free(query.free, query.start, goal, budget.resolution_rad):
            return np.stack([query.start, goal])
    return None


def shortcut(free: Free, path: Float, rng: np.random.Generator, budget: PathBudget) -> Float:
    """Replace pieces of a path (W, n) by straight edges between random points on it, where those are free."""
    for _ in range(budget.shortcuts):
        if len(path) < 3:
            break
        knots = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
        s0, s1 = np.sort(rng.uniform(0, knots[-1], 2))
        i, j = int(np.searchsorted(knots, s0, side="right")), int(np.searchsorted(knots, s1, side="left"))
        if j <= i:
            continue
        a, b = (np.array([np.interp(s, knots, joint) for joint in path.T]) for s in (s0, s1))
        if np.abs(b - a).max() < s1 - s0 - 1e-6 and edge_is_free(free, a, b, budget.resolution_rad):
            path = np.concatenate([path[:i], [a, b], path[j:]])
    return _pull_straight(free, path, budget)


def _pull_straight(free: Free, path: Float, budget: PathBudget) -> Float:
    """Leave out every waypoint whose neighbours see each other."""
    i = 1
    while i < len(path) - 1:
        if edge_is_free(free, path[i - 1], path[i + 1], budget.resolution_rad):
            path = np.delete(path, i, axis=0)
        else:
            i += 1
    return path
