"""Where two fingers could press: contact lines through an object, and across thin walls and rims."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.contacts import closure_score, friction_of_angle
from thinkgrasp.generators.surface import Float, Surface, Upright, depth_gap
from thinkgrasp.types import Scene

_MIN_PAIR_M = 0.006
_MAX_STEEPNESS = 0.75
_WALL_M = 0.005
_RIM_PROBES_M = ((0.010, 0.006), (0.014, 0.006), (0.018, 0.006))
_RIM_DIRECTIONS = 12


@dataclass(frozen=True, eq=False)
class ContactLines:
    """Pairs of contacts as lines; the fingers close along them."""

    middle: Float
    """(N, 3) midway between the contacts [m]."""
    closing: Float
    """(N, 3) unit, from one contact to the other."""
    distance: Float
    """(N,) between the contacts [m]."""
    score: Float
    """(N,) 1.1 - mu of the pair, times the factor for inferred contacts."""

    def __len__(self) -> int:
        return len(self.middle)

    @classmethod
    def concatenate(cls, parts: list[ContactLines]) -> ContactLines:
        """Join batches in order."""
        names = ("middle", "closing", "distance", "score")
        return cls(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))

    @classmethod
    def empty(cls) -> ContactLines:
        """Return a batch of none."""
        z = np.zeros
        return cls(z((0, 3), np.float32), z((0, 3), np.float32), z(0, np.float32), z(0, np.float32))


def pair_lines(
    surface: Surface,
    upright: Upright,
    max_distance_m: float,
    max_friction: float,
    n_seeds: int,
    n_lines: int,
    inferred_factor: float,
    rng: np.random.Generator,
) -> ContactLines:
    """Find pairs of surface points whose line lies in both friction cones.

    Of the pairs whose middles share a cell of 1 cm and whose directions share a sector of 15 degrees, the best is kept.

    Args:
        surface: Seen and inferred points of one object.
        upright: Gives "up"; lines steeper than about 50 degrees are left out, no finger could get below.
        max_distance_m: Largest distance between the contacts.
        max_friction: Friction coefficient of these cones, at most 1.
        n_seeds: How many wanted points are tried as the first contact.
        n_lines: At most so many lines, best first.
        inferred_factor: Factor on the score per contact that was not seen.
        rng: Chooses the seeds.
    """
    wanted = np.flatnonzero(surface.wanted)
    if len(wanted) == 0:
        return ContactLines.empty()
    seeds = np.sort(rng.permutation(wanted)[:n_seeds])
    p, n = surface.points - surface.points.mean(axis=0), surface.normals
    a, na = p[seeds], n[seeds]
    squared = np.sum(a * a, 1)[:, None] + np.sum(p * p, 1)[None] - 2 * a @ p.T
    inward_a = np.sum(na * a, 1)[:, None] - na @ p.T
    inward_b = np.sum(n * p, 1)[None] - a @ n.T
    cone = squared / (1 + max_friction**2)
    closed = (squared > _MIN_PAIR_M**2) & (squared < max_distance_m**2) & (inward_a > 0) & (inward_b > 0)
    closed &= (inward_a * inward_a >= cone) & (inward_b * inward_b >= cone)
    row, column = np.nonzero(closed)
    i, j = seeds[row], column
    closing = surface.points[j] - surface.points[i]
    d = np.linalg.norm(closing, axis=1)
    closing = closing / d[:, None]
    level = np.abs(closing @ upright.up) < _MAX_STEEPNESS
    row, i, j, d, closing = row[level], i[level], j[level], d[level], closing[level]
    if len(i) == 0:
        return ContactLines.empty()
    angle = np.arccos(np.clip(np.minimum(inward_a[row, j], inward_b[row, j]) / d, -1, 1))
    middle = (surface.points[i] + surface.points[j]) / 2
    score = closure_score(friction_of_angle(angle)) * np.where(surface.seen, 1.0, inferred_factor)[[i, j]].prod(axis=0)

    side = np.cross(upright.up, upright.away)
    flip = np.where((closing @ side) * 2 + closing @ upright.away < 0, -1, 1).astype(np.float32)
    closing = closing * flip[:, None]
    sector = np.floor(np.mod(np.arctan2(closing @ upright.away, closing @ side), np.pi) / np.pi * 12).astype(np.int64)
    cell = np.floor((middle - middle.min(axis=0)) / 0.010).astype(np.int64)
    key = ((cell[:, 0] * 512 + cell[:, 1]) * 512 + cell[:, 2]) * 16 + sector
    order = np.lexsort((angle, -score))
    best = order[np.sort(np.unique(key[order], return_index=True)[1])]
    if len(best) > n_lines:
        # A third by score alone; the rest drawn over the whole object, so that every grid cell finds candidates.
        top = best[: n_lines // 3]
        rest = best[n_lines // 3 :]
        best = np.concatenate([top, np.sort(rng.permutation(len(rest))[: n_lines - len(top)])], dtype=np.intp)
        best[len(top) :] = rest[best[len(top) :]]
    return ContactLines(*(a[best].astype(np.float32) for a in (middle, closing, d, score)))


def rim_lines(scene: Scene, seen: Surface, upright: Upright, n_points: int, rng: np.random.Generator) -> ContactLines:
    """Find thin walls seen from above, the rims of cups and bowls and other ridges, and lines across them.

    A point is on a rim when the camera saw free space a little below it to both sides, but not ahead and behind, where
    a mere corner would end. The wall is thinner than depth can tell, so its thickness is assumed; its slope is taken
    from the surface seen below the rim.

    Args:
        scene: Gives the depth image.
        seen: The object's seen surface.
        upright: Gives "up".
        n_points: How many points are probed.
        rng: Chooses them.
    """
    wanted = np.flatnonzero(seen.wanted)
    if len(wanted) == 0:
        return ContactLines.empty()
    tested = np.sort(rng.permutation(wanted)[:n_points])
    p = seen.points[tested]
    side = np.cross(upright.up, upright.away)
    phi = np.arange(_RIM_DIRECTIONS) * np.pi / _RIM_DIRECTIONS
    directions = (np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * upright.away).astype(np.float32)
    both = np.zeros((len(p), _RIM_DIRECTIONS), bool)
    for reach, drop in _RIM_PROBES_M:
        low = p[:, None] - np.float32(drop) * upright.up
        probes = np.stack([low + np.float32(s * reach) * directions for s in (1, -1)])
        free = depth_gap(scene, probes.reshape(-1, 3).astype(np.float32)).reshape(2, len(p), -1) > 0.003
        both |= free.all(axis=0)
    on_rim = both.any(axis=1)
    if not on_rim.any():
        return ContactLines.empty()
    p, both = p[on_rim], both[on_rim]
    level = np.stack([p @ side, p @ upright.away], axis=-1)
    angle = _across_angle(level, np.angle(both @ np.exp(2j * phi)) / 2)
    across = (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * upright.away).astype(np.float32)
    along = np.cross(upright.up, across)
    ends = np.stack([p + np.float32(s * 0.007) * along - np.float32(0.004) * upright.up for s in (1, -1)])
    goes_on = ~(depth_gap(scene, ends.reshape(-1, 3).astype(np.float32)).reshape(2, -1) > 0.003).any(axis=0)
    if not goes_on.any():
        return ContactLines.empty()
    p, across = p[goes_on], across[goes_on]

    tilt, known = _wall_tilt(p, across, seen, upright)
    parts: list[ContactLines] = []
    for share in (1.0, 0.5, 0.0):
        turn = tilt * share
        closing = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * upright.up
        score = closure_score(friction_of_angle(np.abs(tilt - turn))) * np.where(known, 0.9, 0.7)
        chosen = np.ones(len(p), bool) if share == 1.0 else np.abs(tilt) * (1 - share) > 0.15
        parts.append(
            ContactLines(
                (p - np.float32(0.003) * upright.up)[chosen].astype(np.float32),
                closing[chosen].astype(np.float32),
                np.full(int(chosen.sum()), _WALL_M, np.float32),
                score[chosen].astype(np.float32),
            )
        )
    return ContactLines.concatenate(parts)


def _across_angle(level: NDArray[np.floating], probed: NDArray[np.floating]) -> NDArray[np.floating]:
    """Direction (N,) [rad] across the rim: perpendicular to its course where enough rim points lie around.

    Args:
        level: Rim points (N, 2) in the horizontal plane.
        probed: Middle (N,) [rad] of the directions whose probes were free; used where the course is unknown.
    """
    offset = level[None] - level[:, None]
    near = (offset**2).sum(axis=-1) < 0.018**2
    count = near.sum(axis=1)
    offset = (offset - (offset * near[..., None]).sum(axis=1, keepdims=True) / count[:, None, None]) * near[..., None]
    xx, yy, xy = (offset[..., 0] ** 2).sum(1), (offset[..., 1] ** 2).sum(1), (offset[..., 0] * offset[..., 1]).sum(1)
    course = np.arctan2(2 * xy, xx - yy) / 2
    stretched = np.hypot(xx - yy, 2 * xy) > 0.6 * (xx + yy)
    return np.where((count >= 5) & stretched, course + np.pi / 2, probed)


def _wall_tilt(
    rim: Float, across: Float, seen: Surface, upright: Upright
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Slope (N,) [rad] of the wall's normal against the horizontal, and whether any wall was seen below the rim."""
    offset = seen.points[None] - rim[:, None]
    drop = -(offset @ upright.up)
    radial = np.einsum("rsk,rk->rs", offset, across)
    tangential = np.einsum("rsk,rk->rs", offset, np.cross(upright.up, across))
    wall = (drop > 0.005) & (drop < 0.03) & (np.abs(radial) < 0.02) & (np.abs(tangential) < 0.012)
    along = across @ seen.normals.T
    wall &= np.abs(along) > 0.3
    rise = np.where(along > 0, 1, -1) * (seen.normals @ upright.up)[None]
    count = wall.sum(axis=1)
    mean_along = (np.abs(along) * wall).sum(axis=1) / np.maximum(count, 1)
    mean_rise = (rise * wall).sum(axis=1) / np.maximum(count, 1)
    known = count >= 3
    return np.where(known, np.arctan2(mean_rise, np.maximum(mean_along, 1e-6)), 0.0), known
