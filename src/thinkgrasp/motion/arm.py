"""Motions of the arm: to a grasp and up with it, to a place, and home; collision-free and timed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.collision import CarriedBox, Phase, PlanningWorld
from thinkgrasp.motion.limits import JointLimits
from thinkgrasp.motion.ompl_planner import PLANNERS as OMPL_PLANNERS
from thinkgrasp.motion.ompl_planner import OmplPlanner
from thinkgrasp.motion.paths import PathBudget, PathPlanner, PathQuery
from thinkgrasp.motion.rrt_connect import rrt_connect
from thinkgrasp.motion.straight import StraightGrasps, flange_poses, straight_grasps, straight_up
from thinkgrasp.motion.trajectory import Trajectory, time_path

Float = NDArray[np.float64]

NoMotion = Literal["no inverse kinematics", "approach in collision", "no path"]
"""Why there is no motion: the arm does not reach, the way in or up is blocked, or no way leads there."""

_WAYS = 24
"""Ways into a grasp to check for collisions, nearest first."""
_ENOUGH = 6
"""Clear ways to find a path to; any of them will do."""
_BATCH = 256
"""Grasps whose inverse kinematics is solved at once."""
_COARSE_M = 0.025
"""Between two samples of a straight way where only its being clear is asked."""
_ESCAPE_M = 0.30
"""How far up to go at most to get clear before a transfer."""


OWN_PLANNER = "rrt_connect"


def path_planner(name: str) -> PathPlanner:
    """Return a planner of joint-space paths by name.

    Raises:
        ConfigError: No such planner.
        MissingDependency: It is one of the OMPL, which is not installed.
    """
    if name == OWN_PLANNER:
        return rrt_connect
    if name not in OMPL_PLANNERS:
        raise ConfigError(f"no arm planner {name!r}; choose one of {', '.join((OWN_PLANNER, *OMPL_PLANNERS))}")
    return OmplPlanner(name)


@dataclass(frozen=True, eq=False)
class GraspMotion:
    """A whole grasp: each motion starts where the one before ends."""

    to_pregrasp: Trajectory
    approach: Trajectory
    """Straight along the approach direction."""
    lift: Trajectory
    """Straight up."""


class ArmMotion:
    """Plans motions of the UR5e with its 2F-85 against a perceived cloud.

    Args:
        world: What may be hit; the default has what stands still in the cell.
        planner: Finds joint-space paths: "rrt_connect", a planner of the OMPL by name ("RRTstar", as in the paper), or
            a function of one's own.
        budget: When a path is given up.
        standoff_m: Length of the straight way in. Where it cannot start there, half as much again and twice as much are
            tried.
        lift_m: Length of the straight way up.
        straight_speed: Share of the velocity limit on straight moves.
        limits: Rates to time motions by; the ranges are always those of the UR5e.
        seen_at: (6,) where the arm is when the camera looks, so that it is no obstacle to itself [rad].
        seed: Of every plan; the same question gets the same answer.

    Raises:
        ConfigError: A length or the speed is out of range.
    """

    def __init__(
        self,
        world: PlanningWorld | None = None,
        *,
        planner: PathPlanner | str = OWN_PLANNER,
        budget: PathBudget | None = None,
        standoff_m: float = 0.10,
        lift_m: float = 0.15,
        straight_speed: float = 0.5,
        limits: JointLimits = ur5e.LIMITS,
        seen_at: Sequence[float] = HOME_RAD,
        seed: int = 0,
    ) -> None:
        if not (0 < standoff_m <= 0.3 and 0 < lift_m <= 0.5 and 0 < straight_speed <= 1):
            raise ConfigError(
                "arm motion: need 0 < standoff_m <= 0.3, 0 < lift_m <= 0.5, 0 < straight_speed <= 1; "
                f"got {standoff_m}, {lift_m}, {straight_speed}"
            )
        self.world = world or PlanningWorld()
        self.planner = path_planner(planner) if isinstance(planner, str) else planner
        self.budget = budget or PathBudget()
        self.standoff_m = standoff_m
        self.lift_m = lift_m
        self.straight_speed = straight_speed
        self.limits = limits
        self.seen_at = np.array(seen_at, np.float64)
        self.seed = seed

    def plan_grasp(
        self, q_start: Float, T_world_tcp: Float, opening_m: float, cloud_m: NDArray[np.floating]
    ) -> GraspMotion | NoMotion:
        """Plan to a pre-grasp, straight in, and straight up.

        Args:
            q_start: (6,) [rad].
            T_world_tcp: (4, 4) of the grasp, between the fingertips.
            opening_m: Of the gripper, all the way in.
            cloud_m: (P, 3) perceived points in the world, of everything.

        Returns:
            The motions, or the reason why there are none.
        """
        self.world.carry(None)
        self.world.see(cloud_m, self.seen_at)
        T_base_tcp = self.world.mount.in_base(T_world_tcp)
        reason: NoMotion = "no inverse kinematics"
        for standoff_m in self._standoffs_m:
            ways = straight_grasps(T_base_tcp[None], np.array([opening_m]), standoff_m, self.lift_m, q_start)
            if len(ways) == 0:
                break
            reason = "approach in collision"
            clear = np.array(list(islice(self._clear_ways(ways, opening_m), _ENOUGH)))
            if len(clear) == 0:
                continue
            path = self._path(q_start, clear[:, 0], opening_m)
            if path is None:
                return "no path"
            way = clear[int(np.argmin(np.abs(clear[:, 0] - path[-1]).max(axis=1)))]
            return GraspMotion(
                time_path(path, self.limits),
                self._straight(way[: ways.at_grasp + 1]),
                self._straight(way[ways.at_grasp :]),
            )
        return reason

    def reaches(
        self,
        q_start: Float,
        T_world_tcp: Float,
        opening_m: Float,
        cloud_m: NDArray[np.floating],
        *,
        at_most: int | None = None,
    ) -> NDArray[np.bool_]:
        """Say which grasps have a clear way straight in and up; whether a path leads to it is not asked.

        Args:
            q_start: (6,) from where the motion would start [rad].
            T_world_tcp: (N, 4, 4), in the order in which to look at them.
            opening_m: (N,).
            cloud_m: (P, 3) perceived points in the world, of everything.
            at_most: Stop when so many are found; the rest is False.

        Returns:
            (N,) True where it is so.
        """
        self.world.carry(None)
        self.world.see(cloud_m, self.seen_at)
        found = np.zeros(len(T_world_tcp), bool)
        for first in range(0, len(found), _BATCH):
            T = self.world.mount.in_base(T_world_tcp[first : first + _BATCH])
            opening = opening_m[first : first + _BATCH]
            ways = straight_grasps(T, opening, self.standoff_m, self.lift_m, q_start, _COARSE_M)
            for i in np.unique(ways.grasp):
                found[first + i] = self._has_clear_way(ways.of(i), q_start, T[i], float(opening[i]))
                if found.sum() == at_most:
                    return found
        return found

    def plan_to(
        self,
        q_start: Float,
        q_goal: Float,
        opening_m: float,
        cloud_m: NDArray[np.floating],
        carried: CarriedBox | None = None,
    ) -> Trajectory | NoMotion:
        """Plan a transfer to joint angles q_goal (6,) or to any of (G, 6) [rad].

        A start that is too close to something is first left straight up.

        Args:
            q_start: (6,) [rad].
            q_goal: Where to go.
            opening_m: Of the gripper.
            cloud_m: (P, 3) perceived points in the world, without those of what is carried.
            carried: What the gripper holds.
        """
        self.world.carry(carried)
        self.world.see(cloud_m, self.seen_at)
        path = self._path(q_start, np.reshape(q_goal, (-1, 6)), opening_m)
        return "no path" if path is None else time_path(path, self.limits)

    def plan_to_poses(
        self,
        q_start: Float,
        T_world_tcp: Float,
        opening_m: float,
        cloud_m: NDArray[np.floating],
        carried: CarriedBox | None = None,
    ) -> Trajectory | NoMotion:
        """Plan a transfer that brings the fingertips to any of the poses (N, 4, 4); else like `plan_to`."""
        T_base_tcp = self.world.mount.in_base(T_world_tcp)
        q = ur5e.inverse(flange_poses(T_base_tcp, np.full(len(T_base_tcp), opening_m))).reshape(-1, 6)
        goals = ur5e.LIMITS.nearest_to(q_start, q)
        goals = goals[np.isfinite(goals).all(axis=1)]
        if len(goals) == 0:
            return "no inverse kinematics"
        return self.plan_to(q_start, goals, opening_m, cloud_m, carried)

    def direct(self, q_start: Float, q_goal: Float) -> Trajectory:
        """Return the straight joint-space move between two configurations (6,), whatever is in its way."""
        return self._straight(np.stack([q_start, q_goal]))

    def _straight(self, path: Float) -> Trajectory:
        return time_path(path, self.limits, speed=self.straight_speed)

    def _free(self, opening_m: float, phase: Phase, q: Float) -> NDArray[np.bool_]:
        return ~self.world.collides(q, opening_m, phase)

    @property
    def _standoffs_m(self) -> tuple[float, float, float]:
        return self.standoff_m, 1.5 * self.standoff_m, 2 * self.standoff_m

    def _has_clear_way(self, ways: StraightGrasps, q_start: Float, T_base_tcp: Float, opening_m: float) -> bool:
        if any(True for _ in self._clear_ways(ways, opening_m)):
            return True
        for standoff_m in self._standoffs_m[1:]:
            ways = straight_grasps(T_base_tcp[None], np.array([opening_m]), standoff_m, self.lift_m, q_start, _COARSE_M)
            if any(True for _ in self._clear_ways(ways, opening_m)):
                return True
        return False

    def _clear_ways(self, ways: StraightGrasps, opening_m: float) -> Iterator[Float]:
        """Yield the paths (S, 6), nearest first, that touch nothing and start clear of everything."""
        for path in ways.paths[:_WAYS]:
            if self._free(opening_m, "transfer", path[:1])[0] and self._free(opening_m, "contact", path).all():
                yield path

    def _path(self, q_start: Float, goals: Float, opening_m: float) -> Float | None:
        out = self._way_out(q_start, opening_m)
        if out is None:
            return None
        limits = ur5e.LIMITS
        lower, upper = np.minimum(limits.lower, out[-1]), np.maximum(limits.upper, out[-1])
        query = PathQuery(partial(self._free, opening_m, "transfer"), out[-1], goals, lower, upper)
        path = self.planner(query, np.random.default_rng(self.seed), self.budget)
        return None if path is None else np.concatenate([out[:-1], path])

    def _way_out(self, q_start: Float, opening_m: float) -> Float | None:
        """Return the path (K, 6) straight up to the first clear configuration; (1, 6) where the start is clear."""
        if self._free(opening_m, "transfer", q_start[None])[0]:
            return q_start[None]
        path = straight_up(q_start, _ESCAPE_M)
        clear = self._free(opening_m, "transfer", path)
        return path[: int(np.argmax(clear)) + 1] if clear.any() else None
