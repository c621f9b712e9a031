"""RRT-Connect: two trees in joint space that grow towards each other.

References:
    Kuffner and LaValle 2000, RRT-Connect: an efficient approach to single-query path planning.
    Geraerts and Overmars 2007, creating high-quality paths for motion planning (shortcuts).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.motion.paths import Free, PathBudget, PathQuery, direct, edge_points, shortcut

Float = NDArray[np.float64]

_STEP_RAD = 0.6
"""Farthest that a tree grows towards a random configuration."""


def rrt_connect(query: PathQuery, rng: np.random.Generator, budget: PathBudget | None = None) -> Float | None:
    """Find a short path; the straight line is tried first.

    Args:
        query: Start, goals, bounds, and what is free.
        rng: Decides the random configurations and the shortcuts.
        budget: When to give up.

    Returns:
        Waypoints (W, n) [rad] from the start to one of the goals, straight edges between them free; None if none was
        found within the budget, or the start or all goals collide.
    """
    budget = budget or PathBudget()
    goals = query.clear_goals()
    if len(goals) == 0:
        return None
    reachable = replace(query, goals=goals)
    path = direct(reachable, budget)
    if path is None:
        path = _grow(reachable, rng, budget)
        path = path if path is None else shortcut(query.free, path, rng, budget)
    return path


def _grow(query: PathQuery, rng: np.random.Generator, budget: PathBudget) -> Float | None:
    counted = _Counted(query.free)
    low, high = query.region()
    here, there = _Tree(query.start[None]), _Tree(query.goals)
    from_start = True
    while counted.checks < budget.max_checks:
        new = here.extend(rng.uniform(low, high), counted, budget.resolution_rad, _STEP_RAD)
        if new is not None:
            target = here.points[new]
            met = there.extend(target, counted, budget.resolution_rad, np.inf)
            if met is not None and np.array_equal(there.points[met], target):
                first, second = here.to_root(new)[::-1], there.to_root(met)[1:]
                path = np.concatenate([first, second])
                return path if from_start else path[::-1]
        here, there, from_start = there, here, not from_start
    return None


class _Counted:
    """A free function that counts what it is asked."""

    def __init__(self, free: Free) -> None:
        self.free = free
        self.checks = 0

    def __call__(self, q: Float) -> NDArray[np.bool_]:
        self.checks += len(q)
        return self.free(q)


class _Tree:
    """Configurations with their parents; roots are their own."""

    def __init__(self, roots: Float) -> None:
        self._points = np.empty((max(64, 2 * len(roots)), roots.shape[1]))
        self._points[: len(roots)] = roots
        self._parents = list(range(len(roots)))

    @property
    def points(self) -> Float:
        return self._points[: len(self._parents)]

    def extend(self, target: Float, free: Free, resolution_rad: float, reach_rad: float) -> int | None:
        """Grow from the nearest node straight towards the target until something is in the way.

        Returns:
            The last new node, or None if there was no room at all.
        """
        parent = int(np.argmin(((self.points - target) ** 2).sum(axis=1)))
        start = self.points[parent]
        away = float(np.abs(target - start).max())
        if away == 0:
            return parent
        end = target if away <= reach_rad else start + (target - start) * (reach_rad / away)
        points = edge_points(start, end, resolution_rad)
        clear = 0
        for first in range(0, len(points), 8):
            ok = free(points[first : first + 8])
            clear += len(ok) if ok.all() else int(np.argmin(ok))
            if not ok.all():
                break
        if clear == 0:
            return None
        for k in [*range(9, clear - 1, 10), clear - 1]:
            parent = self._add(target if k == len(points) - 1 and end is target else points[k], parent)
        return parent

    def _add(self, point: Float, parent: int) -> int:
        index = len(self._parents)
        if index == len(self._points):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
        self._points[index] = point
        self._parents.append(parent)
        return index

    def to_root(self, index: int) -> Float:
        """Return the points (K, n) from a node to its root."""
        chain = [index]
        while self._parents[chain[-1]] != chain[-1]:
            chain.append(self._parents[chain[-1]])
        return self._points[chain]
