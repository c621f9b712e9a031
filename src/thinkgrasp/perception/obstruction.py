"""The obstruction graph: what hides, rests on, or stands in the gripper's way to what, measured in depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from thinkgrasp.geometry import Float
from thinkgrasp.perception.edges import Edges, tabulate
from thinkgrasp.perception.morphology import Labels
from thinkgrasp.perception.support import Support
from thinkgrasp.types import Array, Mask, Obstruction, Proposal

MIN_HIDING_PX = 12
RESTING_GAP_M = 0.02
UNSEEN_SHARE = 0.25
"""Of a thing's visible height: so much of its underside may be hidden by its own bulge (a ball in a bowl)."""
FINGER_ROOM_M = 0.022
"""Room that one finger with its clearance needs beside a thing."""
FINGER_DEPTH_M = 0.025
"""How far below the top of a thing the fingertips go at least."""
MAX_OPENING_M = 0.085
N_DIRECTIONS = 12


@dataclass(frozen=True, eq=False)
class _Points:
    """Visible points of one proposal: footprint (N, 2) and height (N,) [m]."""

    xy: Float
    height: Float

    @property
    def top(self) -> float:
        return float(np.percentile(self.height, 97))


def obstruction_graph(
    marks: Labels, scale: int, points: Array, edges: Edges, proposals: tuple[Proposal, ...], support: Support
) -> tuple[Obstruction, ...]:
    """Relate the proposals to one another.

    * a hides b: along their common border a is nearer by a step. Evidence: border length [image px].
    * a rests on b: in contact, and a's lowest visible points lie over b and above the support. Evidence: how far a's
      lowest point is above b's top there; negative when a stands in b [m].
    * a blocks b: in every closing direction that fits the gripper something leaves less room beside b than a finger
      needs; a is what is in the way of the freest direction. Evidence: the room that is left [m].

    Args:
        marks: (h, w) marks 1..n at working resolution.
        scale: Image pixels per working pixel.
        points: (h, w, 3) [m].
        edges: Borders between marks.
        proposals: Numbered 1..n.
        support: The surface.
    """
    n = len(proposals)
    if n < 2:
        return ()
    contact, front = tabulate(edges, n)
    bodies = [_points(marks == p.mark, points, support) for p in proposals]
    found: list[Obstruction] = []
    for a in range(n):
        for b in range(n):
            if a == b:
                continue
            if front[a, b] * scale >= MIN_HIDING_PX and front[a, b] > 2 * front[b, a]:
                found.append(Obstruction("hides", a + 1, b + 1, float(front[a, b] * scale), "px"))
            gap = _resting_gap(bodies[a], bodies[b]) if contact[a, b] + front[a, b] >= 4 else None
            if gap is not None:
                found.append(Obstruction("rests_on", a + 1, b + 1, round(gap, 4), "m"))
    carried = {(e.a, e.b) for e in found if e.relation == "rests_on"}
    for b in range(n):
        found.extend(
            e for e in _blocking(b, bodies, proposals) if (e.a, e.b) not in carried and (e.b, e.a) not in carried
        )
    return tuple(found)


def _points(mask: Mask, points: Array, support: Support, limit: int = 250) -> _Points:
    index = np.flatnonzero(mask & np.isfinite(points[..., 2]))
    p = points.reshape(-1, 3)[index[:: max(1, len(index) // limit)]].astype(np.float64)
    return _Points(support.footprint(p).astype(np.float64), support.plane.height(p).astype(np.float64))


def _resting_gap(a: _Points, b: _Points) -> float | None:
    """Height of a's lowest points above b's surface below them [m]; None when a does not rest on b."""
    if len(a.height) < 10 or len(b.height) < 10 or a.top < b.top - 0.03 or np.median(a.height) < np.median(b.height):
        return None
    low = a.height < np.percentile(a.height, 20)
    bottom = float(np.percentile(a.height, 4))
    if bottom < 0.012:
        return None
    distance, nearest = (np.asarray(column) for column in KDTree(b.xy).query(a.xy[low]))
    over = distance < 0.012
    if over.mean() < 0.3:
        return None
    gap = float(np.median(a.height[low][over] - b.height[nearest[over]]))
    unseen = UNSEEN_SHARE * (a.top - bottom)
    return gap if -0.06 < gap < RESTING_GAP_M + unseen else None


def _blocking(b: int, bodies: list[_Points], proposals: tuple[Proposal, ...]) -> list[Obstruction]:
    own = bodies[b]
    if len(own.height) < 10:
        return []
    reach = float(np.ptp(own.xy, axis=0).max()) / 2 + MAX_OPENING_M
    middle = (own.xy.min(axis=0) + own.xy.max(axis=0)) / 2
    depth = own.top - FINGER_DEPTH_M
    near = [
        i
        for i, other in enumerate(bodies)
        if i != b
        and len(other.height) >= 10
        and other.top > depth
        and np.linalg.norm(other.xy - middle, axis=1).min(initial=np.inf) < reach
    ]
    if not near:
        return []
    angles = np.arange(N_DIRECTIONS) * np.pi / N_DIRECTIONS
    closing = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    along_own = (own.xy - middle) @ closing.T
    low, high = along_own.min(axis=0), along_own.max(axis=0)
    fits = high - low < MAX_OPENING_M
    if not fits.any():
        fits = np.ones(N_DIRECTIONS, bool)
    room = np.full((len(near), N_DIRECTIONS), np.inf)
    for row, i in enumerate(near):
        tall = bodies[i].height > depth
        offset = bodies[i].xy[tall] - middle
        along = offset @ closing.T
        across = np.abs(offset @ np.stack([-closing[:, 1], closing[:, 0]], axis=1).T)
        beside = np.maximum(along - high, low - along)
        room[row] = np.where(across < 0.015, np.maximum(beside, 0.0), np.inf).min(axis=0)
    worst = np.where(fits, room.min(axis=0), -1.0)
    freest = int(np.argmax(worst))
    if worst[freest] >= FINGER_ROOM_M:
        return []
    return [
        Obstruction("blocks", proposals[i].mark, proposals[b].mark, round(float(room[row, freest]), 4), "m")
        for row, i in enumerate(near)
        if room[row, freest] < FINGER_ROOM_M
    ]
