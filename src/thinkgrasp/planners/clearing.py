"""What has to go first: the way to a goal that something obstructs, and what may hide a goal that is not seen."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from thinkgrasp.types import Obstruction, Proposal, Scene

MAX_HIDDEN_SHARE = 0.3
"""A thing that hides more than this share of the goal's whole outline goes first."""
TIGHT_M = 0.010
"""Clearance beside a goal that no finger enters."""
TOWERING_M = 0.03
"""A blocking thing matters where it is higher than the goal by this much."""
MIN_BLOCKERS = 2
MIN_CONFIDENCE = 0.25
PILE_SIZE = 4
"""So many things in contact are a pile, even when none is seen to rest on another."""
STACKED_PILE_SIZE = 3
"""So many are one where something rests on another; a cup on a box hides nothing that would not show."""


@dataclass(frozen=True)
class Way:
    """The marks from the goal to the thing to remove first, and why each is in the way of the one before."""

    marks: tuple[int, ...]
    edges: tuple[Obstruction, ...]

    @property
    def first(self) -> int:
        """The mark to take now; the goal's own where nothing is in the way."""
        return self.marks[-1]


def severity(scene: Scene, edge: Obstruction) -> float:
    """Return how much an edge's `a` is in the way of its `b`, 0..1; from 0.5 on it has to go first."""
    a, b = scene.proposal(edge.a), scene.proposal(edge.b)
    if a.confidence < MIN_CONFIDENCE:
        return 0.0
    if edge.relation == "rests_on":
        return 1.0
    if edge.relation == "hides":
        share = edge.evidence / max(edge.evidence + float(b.mask.sum()), 1.0)
        return min(1.0, 0.5 * share / MAX_HIDDEN_SHARE)
    tight = 1 - min(max(edge.evidence, 0.0) / (2 * TIGHT_M), 1.0)
    return tight if a.height_m[1] > b.height_m[1] + TOWERING_M else 0.4 * tight


def in_the_way(scene: Scene, mark: int, skip: Collection[int] = ()) -> list[tuple[float, Obstruction]]:
    """Return what has to go before a mark can be taken, worst first.

    A thing that blocks one side only leaves the other sides to the gripper, so that a blocking neighbour counts when
    there are at least MIN_BLOCKERS of them.
    """
    judged = [(severity(scene, e), e) for e in scene.obstructing(mark) if e.a != mark and e.a not in skip]
    severe = [(s, e) for s, e in judged if s >= 0.5]
    blockers = {e.a for _, e in severe if e.relation == "blocks"}
    if len(blockers) < MIN_BLOCKERS:
        severe = [(s, e) for s, e in severe if e.relation != "blocks"]
    order = {"rests_on": 0, "hides": 1, "blocks": 2}
    return sorted(severe, key=lambda item: (order[item[1].relation], -item[0], item[1].a))


def way_to(scene: Scene, goal: int, skip: Collection[int] = ()) -> Way:
    """Follow what is in the way of a goal up to a thing that is itself free.

    Args:
        scene: With its obstruction graph.
        goal: Mark that is wanted.
        skip: Marks not to remove, because that failed before.
    """
    marks, edges = [goal], []
    while True:
        severe = in_the_way(scene, marks[-1], {*skip, *marks})
        if not severe:
            return Way(tuple(marks), tuple(edges))
        edges.append(severe[0][1])
        marks.append(severe[0][1].a)


@dataclass(frozen=True)
class Hider:
    """A thing that may hide an unseen goal, or is only next in turn."""

    mark: int
    score: float
    reason: str
    suspected: bool = True
    """Whether something speaks for its hiding the goal."""


def likely_hider(
    scene: Scene, longest_m: float, shortest_m: float, *, in_piles_only: bool, skip: Collection[int] = ()
) -> Hider | None:
    """Find the thing that most likely hides an unseen goal.

    Args:
        scene: Proposals and their graph.
        longest_m: Longest side that the goal has at least.
        shortest_m: Shortest side that it has at least.
        in_piles_only: Do not look behind things that stand free.
        skip: Marks not to consider, because removing them failed before.

    Returns:
        The highest thing in a pile, which lies over most of it; else the one that stands free with the most hidden room
        behind it; None where nothing can hide the goal.
    """
    found: list[Hider] = []
    for pile in piles(scene):
        for mark in sorted(pile - set(skip)):
            thing = scene.proposal(mark)
            if in_the_way(scene, mark, skip) or not _covers(thing, longest_m, shortest_m):
                continue
            top = thing.height_m[1]
            found.append(Hider(mark, top, f"it lies in a pile of {len(pile)} and reaches {top:.2f} m up"))
    if not found and not in_piles_only and scene.support is not None:
        for thing in scene.proposals:
            room = shadow_m(scene, thing)
            if thing.mark in skip or in_the_way(scene, thing.mark, skip) or thing.confidence < MIN_CONFIDENCE:
                continue
            width, depth, height = room
            if shortest_m <= min(depth, height / 2) and longest_m <= max(width, depth):
                reason = f"the camera does not see {width:.2f} x {depth:.2f} m behind it"
                found.append(Hider(thing.mark, width * depth, reason))
    return max(found, key=lambda h: (h.score, -h.mark), default=None)


def next_to_clear(scene: Scene, skip: Collection[int] = ()) -> Hider | None:
    """Find the thing to remove where nothing in particular is known to hide the goal: high, whole, free if any."""
    found: list[Hider] = []
    for p in scene.proposals:
        if p.mark in skip or p.confidence < MIN_CONFIDENCE:
            continue
        free = not in_the_way(scene, p.mark, skip)
        reason = f"it is {'free and ' if free else ''}{p.height_m[1]:.2f} m high"
        found.append(Hider(p.mark, float(free) + p.height_m[1] * p.confidence, reason, suspected=False))
    return max(found, key=lambda h: (h.score, -h.mark), default=None)


def piles(scene: Scene) -> list[set[int]]:
    """Group the marks that rest on each other or are in contact; only groups that are piles are returned."""
    groups: dict[int, set[int]] = {p.mark: {p.mark} for p in scene.proposals}
    stacked: set[int] = set()
    for e in scene.obstructions:
        touching = e.relation == "rests_on" or (e.relation == "blocks" and e.evidence < TIGHT_M)
        if not touching or e.a not in groups or e.b not in groups:
            continue
        if e.relation == "rests_on":
            stacked |= {e.a, e.b}
        merged = groups[e.a] | groups[e.b]
        for mark in merged:
            groups[mark] = merged
    unique = {min(g): g for g in groups.values()}
    return [g for _, g in sorted(unique.items()) if len(g) >= (STACKED_PILE_SIZE if g & stacked else PILE_SIZE)]


def _covers(thing: Proposal, longest_m: float, shortest_m: float) -> bool:
    """Whether a goal of that size can lie under or behind a thing without showing much."""
    top = thing.height_m[1]
    return thing.confidence >= MIN_CONFIDENCE and thing.extents_m[0] >= 0.6 * longest_m and top >= 0.8 * shortest_m


def shadow_m(scene: Scene, thing: Proposal) -> tuple[float, float, float]:
    """Return width, depth and height [m] of the room behind a thing that the camera cannot see."""
    if scene.support is None:
        return 0.0, 0.0, 0.0
    center = thing.center_m
    sin = float(np.clip(-(center @ scene.support.normal) / max(float(np.linalg.norm(center)), 1e-6), 0.05, 1))
    height = max(thing.height_m[1], 0.0)
    x0, _, x1, _ = thing.box_xyxy
    width = (x1 - x0) * float(center[2]) / scene.frame.camera.fx
    return width, height * float(np.sqrt(1 - sin**2)) / sin, height
