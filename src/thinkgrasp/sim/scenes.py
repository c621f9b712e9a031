"""Seeded piles on the table: what lies in them, how it fell, and how much of each goal the default camera sees.

A seed gives the same pile, bit for bit. Whether a goal is visible, partly hidden or hidden is measured by ray casting
and never assumed; a pile that is not as requested is thrown away and another is made from the next sub-seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.goals import goals_in
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.paper_cases import Layout
from thinkgrasp.sim.piles import SCATTER_M, TAKEABLE_M, Pile, needs_its_rim
from thinkgrasp.sim.truth import visible_fraction
from thinkgrasp.sim.views import default_view
from thinkgrasp.sim.world import World

Float = NDArray[np.float64]
Visibility = Literal["visible", "partly", "hidden"]
Pool = Literal["seen", "unseen", "all"]

VISIBLE_SHARE: dict[Visibility, tuple[float, float]] = {
    "visible": (0.7, 1.0),
    "partly": (0.15, 0.7),
    "hidden": (0.0, 0.03),
}
"""Range of the share of a goal's pixels that nothing hides; every goal of the pile must lie in it."""
CLUTTER_OBJECTS = (8, 15)
HIDING_OBJECTS = 12
"""Fewer clutter objects seldom hide a goal completely."""
HEAVY_OBJECTS = (20, 30)
SELECTIONS, TRIES_PER_SELECTION = 60, 2
"""How often objects are chosen, and piles made of the same objects, before it is given up."""
TRIES_PER_LAYOUT = 4
VIEW_SIZE = (224, 224)


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """What falls onto the table."""

    instruction: str
    objects: tuple[SimObject, ...]
    goals: tuple[int, ...]
    """Indices of all objects that truly serve the instruction."""
    drops: Float
    """(N, 4, 4) T_world_object at the start of each object's fall."""
    seed: int
    visibility: Visibility | None
    """What was asked for; None = as it falls."""


@dataclass(frozen=True, eq=False)
class PiledScene:
    """A pile at rest."""

    spec: SceneSpec
    poses: Float
    """(N, 4, 4) T_world_object."""
    visible_fractions: tuple[float, ...]
    """Per goal, the share 0..1 of its pixels in the default view that nothing hides."""
    tries: int
    """How many piles were made until one was as asked for."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Objects for one pile, and which of them serve the instruction."""

    objects: tuple[SimObject, ...]
    goals: tuple[int, ...]


def clutter(
    instruction: str,
    seed: int,
    *,
    n_objects: int | None = None,
    n_goals: int = 1,
    visibility: Visibility | None = None,
    pool: Pool = "seen",
    own: Sequence[SimObject] = (),
) -> PiledScene:
    """Make a pile of household objects of which some serve an instruction.

    Args:
        instruction: What will be asked for.
        seed: The same seed gives the same pile.
        n_objects: How many; None = 8 to 15 by the seed.
        n_goals: How many objects shall serve the instruction, as far as there are different ones; no other does.
        visibility: Of every goal, in the default view; None = as it falls.
        pool: The names to choose from.
        own: The goal comes from these instead of the catalogue, and there is one.

    Raises:
        InputError: Nothing that could be a goal serves the instruction; the message lists what there is. Or no pile
            came out as asked for.
        ConfigError: A number of objects or goals that makes no pile, or a negative seed.
    """
    _check(n_objects, n_goals, seed)

    def select(rng: Generator) -> Selection:
        fewest = HIDING_OBJECTS if visibility == "hidden" else CLUTTER_OBJECTS[0]
        n = n_objects or int(rng.integers(fewest, CLUTTER_OBJECTS[1] + 1))
        return choose(instruction, n, n_goals, pool, rng, own)

    return make_pile(instruction, select, seed, visibility)


def heavy(
    instruction: str,
    seed: int,
    *,
    n_objects: int | None = None,
    n_goals: int = 1,
    visibility: Visibility | None = None,
) -> PiledScene:
    """Make a pile of 20 to 30 objects of the names kept for the heavy suite; otherwise as `clutter`."""
    _check(n_objects, n_goals, seed)

    def select(rng: Generator) -> Selection:
        n = n_objects or int(rng.integers(HEAVY_OBJECTS[0], HEAVY_OBJECTS[1] + 1))
        return choose(instruction, n, n_goals, "unseen", rng)

    return make_pile(instruction, select, seed, visibility)


def published(layout: Layout, *, seed: int = 0, own: Mapping[str, SimObject] | None = None) -> PiledScene:
    """Drop the objects of a published layout as its file says, with the same instruction and goals.

    Catalogue objects of the same kind stand in for the published ones, so that the pile is alike, not equal. What falls
    out of the workspace is put back. A pile that does not come to rest is made anew with other stand-ins.

    Args:
        layout: From `thinkgrasp.sim.paper_cases.load_case`.
        seed: Of the stand-ins' variation, and of where things are put back.
        own: Objects to use instead of stand-ins, by published id.

    Raises:
        InputError: `own` names an id that the layout does not have, or no pile comes to rest.
    """
    rng = _rng(seed, layout.name)
    for tries in range(1, TRIES_PER_LAYOUT + 1):
        objects = layout.objects(seed if tries == 1 else int(rng.integers(2**31)), own)
        pile = Pile(World(objects, robot=False), rng)
        for index, T in enumerate(layout.poses):
            pile.drop_at(index, T)
        if pile.settle():
            spec = SceneSpec(layout.instruction, objects, layout.goals, pile.drops, seed, None)
            return PiledScene(spec, pile.world.poses(), _shares(pile.world, layout.goals), tries)
    raise InputError(
        f"no pile of {layout.name!r} came to rest inside the workspace with seed {seed} in {TRIES_PER_LAYOUT} tries; "
        "take another seed"
    )


def choose(
    instruction: str, n_objects: int, n_goals: int, pool: Pool, rng: Generator, own: Sequence[SimObject] = ()
) -> Selection:
    """Choose objects for a pile: goals, and others of which none serves the instruction.

    Names differ as long as there are enough of them.

    Raises:
        InputError: Nothing serves the instruction.
    """
    samples = _samples(pool)
    source = tuple(own) or samples
    serving = [source[i] for i in goals_in(instruction, source)]
    if not serving:
        raise InputError(f"{instruction!r} names nothing that could be put on the table; {_listing(source, own)}")
    chosen = [serving[i] for i in rng.permutation(len(serving))[: 1 if own else n_goals]]
    others = [
        s for s in samples if 1 not in goals_in(instruction, (chosen[0], s)) and s.name not in {c.name for c in own}
    ]
    rounds = -(-max(n_objects - len(chosen), 0) // max(len(others), 1))
    order = np.concatenate([rng.permutation(len(others)) for _ in range(max(rounds, 1))])
    objects = [c if own else catalogue.make(c.name, int(rng.integers(2**31))) for c in chosen]
    for i in order[: n_objects - len(chosen)]:
        objects.append(catalogue.make(others[i].name, int(rng.integers(2**31))))
    return Selection(tuple(objects), tuple(range(len(chosen))))


def make_pile(
    instruction: str, select: Callable[[Generator], Selection], seed: int, visibility: Visibility | None
) -> PiledScene:
    """Make piles until one is at rest inside the workspace with its goals takeable and as visible as asked for.

    Args:
        instruction: What will be asked for.
        select: Chooses the objects; called again after TRIES_PER_SELECTION piles.
        seed: The same seed gives the same pile.
        visibility: Of every goal; None = as it falls.

    Raises:
        InputError: No pile of SELECTIONS selections of objects was as asked for.
        ConfigError: No such visibility.
    """
    if visibility is not None and visibility not in VISIBLE_SHARE:
        raise ConfigError(f"no visibility {visibility!r}; allowed are {', '.join(VISIBLE_SHARE)}, or none")
    low, high = VISIBLE_SHARE[visibility] if visibility else (0.0, 1.0)
    tries = 0
    for turn in range(SELECTIONS):
        selection = select(_rng(seed, instruction, 0, turn))
        world = World(selection.objects, robot=False)
        for _ in range(TRIES_PER_SELECTION):
            tries += 1
            pile = Pile(world, _rng(seed, instruction, 1, tries))
            if not _pour(pile, selection, visibility):
                continue
            shares = _shares(world, selection.goals)
            takeable = all(is_takeable(selection.objects[g], world.pose(g)) for g in selection.goals)
            if takeable and all(low <= share <= high for share in shares):
                spec = SceneSpec(instruction, selection.objects, selection.goals, pile.drops, seed, visibility)
                return PiledScene(spec, world.poses(), shares, tries)
    wanted = f"with the goal {visibility}" if visibility else "inside the workspace"
    raise InputError(
        f"no pile {wanted} came out for {instruction!r} in {tries} tries; take another seed or more objects"
    )


def is_takeable(obj: SimObject, T_world_object: Float) -> bool:
    """Whether a two-finger gripper can take a thing as it lies, if nothing is in the way.

    A wide vessel has to show its rim: upside down there is nothing to hold. A plain block must not lie on a face of
    which both sides are wider than the gripper opens.
    """
    if needs_its_rim(obj):
        return bool(T_world_object[2, 2] > 0.5)
    if len(obj.collisions) == 1 and obj.collisions[0].shape in ("box", "hull"):
        level = np.abs(T_world_object[2, :3]) < 0.7
        return bool((np.diff(obj.bounds_m, axis=0)[0][level] <= TAKEABLE_M).any())
    return True


def _pour(pile: Pile, selection: Selection, visibility: Visibility | None) -> bool:
    """Drop everything; return whether it came to rest inside the workspace, or False as soon as it is of no use."""
    goals = selection.goals
    others = [int(i) for i in pile.rng.permutation(len(selection.objects)) if i not in goals]
    if visibility is None or visibility == "visible":
        order = [*others, *goals] if visibility else pile.rng.permutation([*others, *goals])
        for index in order:
            pile.scatter(int(index))
        return pile.settle()
    others.sort(key=lambda i: _footprint_m2(selection.objects[i]), reverse=visibility == "hidden")
    for goal in goals:
        pile.drop(goal, _CENTER + pile.rng.uniform(-0.05, 0.05, 2))
    pile.settle()
    low, high = VISIBLE_SHARE[visibility]
    aim = high - COVER_MARGIN * (high - low)
    for index in others:
        shares, lay = _shares(pile.world, goals), pile.world.poses()
        worst = pile.world.center(goals[int(np.argmax(shares))])[:2]
        if max(shares) >= aim:
            pile.drop(index, worst + pile.rng.normal(COVER_AT_M, COVER_SPREAD_M))
            pile.wait()
            if min(_shares(pile.world, goals)) >= low:
                continue
            pile.take_back(index, lay)
        if visibility == "hidden":
            pile.scatter(index)
        else:
            away = pile.rng.uniform(0, 2 * np.pi)
            pile.drop(index, worst + APART_M * np.array([np.cos(away), np.sin(away)]))
    return pile.settle() and max(_shares(pile.world, goals)) <= high


COVER_MARGIN = 0.2
"""Things are dropped onto a goal until what is seen of it lies this far inside the range, then elsewhere."""
COVER_AT_M = np.array([0.05, 0.0])
"""Where they are dropped, from the goal's middle: a little towards the camera."""
COVER_SPREAD_M = 0.025
APART_M = 0.16
_CENTER = np.mean(SCATTER_M, axis=1)


def _footprint_m2(obj: SimObject) -> float:
    """Return the area of the largest side of an object's bounding box."""
    sides = np.sort(np.diff(obj.bounds_m, axis=0)[0])
    return float(sides[1] * sides[2])


def _shares(world: World, goals: tuple[int, ...]) -> tuple[float, ...]:
    view = default_view(size_wh=VIEW_SIZE)
    return tuple(visible_fraction(world, view, goal) for goal in goals)


@lru_cache(maxsize=3)
def _samples(pool: Pool) -> tuple[SimObject, ...]:
    """One object of every name, to ask what it is."""
    return tuple(catalogue.make(name) for name in (catalogue.names() if pool == "all" else catalogue.split(pool)))


def _rng(seed: int, instruction: str, *purpose: int) -> Generator:
    return np.random.default_rng([seed, *purpose, *instruction.encode()])


def _check(n_objects: int | None, n_goals: int, seed: int) -> None:
    if seed < 0:
        raise ConfigError(f"a seed must not be negative, got {seed}")
    if n_goals < 1 or (n_objects is not None and not n_goals <= n_objects <= HEAVY_OBJECTS[1]):
        raise ConfigError(
            f"a pile has up to {HEAVY_OBJECTS[1]} objects and one goal at least, got {n_objects} and {n_goals}"
        )


def _listing(source: Sequence[SimObject], own: Sequence[SimObject]) -> str:
    names = sorted({obj.name for obj in source})
    return f"{'your objects are' if own else 'there are'} {', '.join(names)}"
