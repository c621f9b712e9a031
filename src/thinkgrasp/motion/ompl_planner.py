"""Planners of the Open Motion Planning Library, asked like `rrt_connect`: RRT* as in the paper, and others.

References:
    Sucan, Moll and Kavraki 2012, The Open Motion Planning Library. Qian et al., ThinkGrasp, CoRL 2024 (RRT*).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.motion.paths import PathBudget, PathQuery, shortcut

Float = NDArray[np.float64]

PLANNERS = ("RRTstar", "RRTConnect", "RRT", "InformedRRTstar", "BITstar")
"""Those with "star" spend the whole budget on shorter paths, the others stop at the first. The library's PRM planners
ask from threads of their own, which a Python callback does not survive."""


class OmplPlanner:
    """Find joint-space paths by one of the library's planners.

    Args:
        name: One of PLANNERS.

    Raises:
        ConfigError: No such planner.
        MissingDependency: The library is not installed.
    """

    def __init__(self, name: str = "RRTstar") -> None:
        if name not in PLANNERS:
            raise ConfigError(f"no planner {name!r}; choose one of {', '.join(PLANNERS)}")
        try:
            from ompl import base, geometric, util
        except ModuleNotFoundError as error:
            raise MissingDependency("ompl", "ompl", f"the planner {name}") from error
        self.name = name
        self._base: Any = base
        self._geometric: Any = geometric
        self._util: Any = util
        util.setLogLevel(util.LOG_ERROR)

    def __call__(self, query: PathQuery, rng: np.random.Generator, budget: PathBudget | None = None) -> Float | None:
        """Find a path; arguments and result as of `rrt_connect`, the straight line is not tried first."""
        budget = budget or PathBudget()
        goals = query.clear_goals()
        if len(goals) == 0:
            return None
        self._seed(rng)
        base = self._base
        n = len(query.start)
        space = base.RealVectorStateSpace(n)
        bounds = base.RealVectorBounds(n)
        low, high = query.region()
        for i in range(n):
            bounds.setLow(i, float(low[i]))
            bounds.setHigh(i, float(high[i]))
        space.setBounds(bounds)
        setup = self._geometric.SimpleSetup(space)
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(budget.resolution_rad / space.getMaximumExtent())

        checks = 0

        def valid(state: Any) -> bool:
            nonlocal checks
            checks += 1
            return bool(query.free(np.array([[state[i] for i in range(n)]]))[0])

        def state_of(q: Float) -> Any:
            state = space.allocState()
            for i in range(n):
                state[i] = float(q[i])
            return state

        setup.setStateValidityChecker(valid)
        setup.setStartState(state_of(query.start))
        ends = base.GoalStates(information)
        for goal in goals:
            ends.addState(state_of(goal))
        setup.setGoal(ends)
        setup.setPlanner(getattr(self._geometric, self.name)(information))
        setup.solve(base.PlannerTerminationCondition(lambda: checks >= budget.max_checks))
        if not setup.haveExactSolutionPath():
            return None
        states = setup.getSolutionPath().getStates()
        path = np.array([[state[i] for i in range(n)] for state in states])
        path[0], path[-1] = query.start, goals[np.argmin(np.abs(goals - path[-1]).max(axis=1))]
        return shortcut(query.free, path, rng, budget)

    def _seed(self, rng: np.random.Generator) -> None:
        """Start the library's generators anew; it complains, as those already made keep their own course."""
        self._util.setLogLevel(self._util.LOG_NONE)
        self._util.RNG.setSeed(int(rng.integers(1, 2**31)))
        self._util.setLogLevel(self._util.LOG_ERROR)
