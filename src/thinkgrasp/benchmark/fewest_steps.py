"""The fewest grasps until a goal is out, searched in the physics: what every step count is compared with."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

import heapq
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from thinkgrasp.benchmark.reachability import Reachability
from thinkgrasp.errors import ConfigError
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.sim.scenes import PiledScene
from thinkgrasp.sim.world import World

Float = NDArray[np.float64]

SETTLE_S = 1.5
"""What a removal sets in motion comes to rest in this simulated time, or is looked at as it is then."""
NODE_LIMIT = 60
N_NEAREST = 3
"""Where nothing that is known to be in the way can be taken, so many takeable things nearest to a goal are tried."""


@dataclass(frozen=True)
class Fewest:
    """The fewest executed grasps until a goal is out, as far as the search got."""

    steps: int | None
    """The last one takes the goal; None = no way was found."""
    exact: bool
    """Whether the search was completed; else `steps` is an upper bound."""
    order: tuple[int, ...]
    """Objects to take, the goal last; empty where no way was found."""
    states: int
    """Piles that were looked at."""

    def __str__(self) -> str:
        if self.steps is None:
            return "unknown"
        return str(self.steps) if self.exact else f"at most {self.steps}"


@dataclass(frozen=True, eq=False)
class _State:
    """A pile at rest after some things were taken out."""

    taken: tuple[int, ...]
    poses: Float
    """(N, 4, 4)."""
    goal: int | None
    """One that can be taken now."""
    choices: tuple[int, ...]
    """What to take next, most promising first."""
    least: int
    """How many things block the freest goal."""
    known: bool
    """Whether the choices are obstructions, not only what lies nearby."""


def fewest_steps(scene: PiledScene, limit: int = NODE_LIMIT) -> Fewest:
    """Search for the fewest grasps that take out things in the way, and then a goal.

    It is about the world, not the view: a goal that no camera sees but a grasp reaches can be taken. Each grasp is
    assumed to succeed and to disturb nothing: the thing vanishes, the rest settles in the physics. Tried are the things
    that `Reachability.obstructions` names and that can be taken themselves; a set of things taken counts once, whatever
    the order. Best first: states by the number taken and of things that block the freest goal still, as no removal
    frees more than one of those. Where the search is cut off, or it had to try things that are not known to be in the
    way, what was found is an upper bound.

    Args:
        scene: The pile and its goals.
        limit: States to look at before giving up.

    Raises:
        ConfigError: The limit is below 1.
    """
    if limit < 1:
        raise ConfigError(f"fewest_steps: limit must be at least 1, got {limit}")
    return _Search(scene, limit).run()


class _Search:
    def __init__(self, scene: PiledScene, limit: int) -> None:
        self._limit = limit
        self._world = World(scene.spec.objects, robot=False)
        self._motion = ArmMotion()
        self._goals = scene.spec.goals
        self._seen: dict[frozenset[int], _State] = {}
        self._start = scene.poses

    def run(self) -> Fewest:
        root = self._look((), self._start)
        best = self._dive(root)
        complete = True
        queue: list[tuple[int, int, tuple[int, ...]]] = [(self._bound(root), 0, ())]
        queued = {frozenset[int]()}
        while queue:
            bound, _, taken_before = heapq.heappop(queue)
            state = self._seen[frozenset(taken_before)]
            if best is not None and bound >= len(best.taken) + 1:
                break
            complete &= state.known
            for index in state.choices:
                taken = frozenset((*state.taken, index))
                if taken in queued:
                    continue
                queued.add(taken)
                if taken not in self._seen and len(self._seen) >= self._limit:
                    complete = False
                    continue
                after = self._take(state, index)
                if after.goal is not None and (best is None or len(after.taken) < len(best.taken)):
                    best = after
                if after.goal is None and after.choices:
                    heapq.heappush(queue, (self._bound(after), -len(after.taken), after.taken))
        if best is None or best.goal is None:
            return Fewest(None, False, (), len(self._seen))
        return Fewest(len(best.taken) + 1, complete, (*best.taken, best.goal), len(self._seen))

    def _dive(self, state: _State) -> _State | None:
        """Take what is most promising until a goal can be taken."""
        while state.goal is None:
            if not state.choices or len(self._seen) >= self._limit:
                return None
            state = self._take(state, state.choices[0])
        return state

    @staticmethod
    def _bound(state: _State) -> int:
        return len(state.taken) + 1 + (state.least if state.goal is None else 0)

    def _take(self, state: _State, index: int) -> _State:
        taken = (*state.taken, index)
        key = frozenset(taken)
        if key not in self._seen:
            self._set_up(taken, state.poses)
            self._world.settle(max_seconds=SETTLE_S)
            self._seen[key] = self._look(taken, self._world.poses())
        return self._seen[key]

    def _set_up(self, taken: tuple[int, ...], poses: Float) -> None:
        mujoco.mj_resetData(self._world.model, self._world.data)
        for index, T in enumerate(poses):
            if index in taken:
                self._world.park(index)
            else:
                self._world.place(index, T)
        mujoco.mj_forward(self._world.model, self._world.data)

    def _look(self, taken: tuple[int, ...], poses: Float) -> _State:
        self._set_up(taken, poses)
        truth = Reachability(self._world, self._goals, motion=self._motion)
        goals = [g for g in self._goals if self._world.on_table(g)]
        goal = next((g for g in goals if truth.takeable(g)), None)
        choices: list[int] = []
        least, known = 0, True
        if goal is None:
            first = {g: truth.blockers(g) for g in goals}
            least = min((truth.blocking_size(g) for g in goals if first[g]), default=1)
            direct = frozenset[int]().union(*first.values())
            found = frozenset[int]().union(*(truth.obstructions(g) for g in goals))
            choices = sorted((i for i in found if truth.takeable(i)), key=lambda i: (i not in direct, i))
            known = bool(choices)
            if not choices and goals:
                choices = self._nearest(truth, goals)
        state = _State(taken, poses, goal, tuple(choices), max(least, 1), known)
        self._seen[frozenset(taken)] = state
        return state

    def _nearest(self, truth: Reachability, goals: list[int]) -> list[int]:
        centers = np.array([self._world.center(i) for i in range(len(self._world.objects))])
        away = np.min([np.linalg.norm(centers - centers[g], axis=1) for g in goals], axis=0)
        order = (i for i in np.argsort(away, kind="stable").tolist() if i not in goals and truth.takeable(i))
        return [i for _, i in zip(range(N_NEAREST), order, strict=False)]
