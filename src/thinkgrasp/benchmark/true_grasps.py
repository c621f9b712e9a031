"""Grasps on an object's true surface, in its own frame: what two fingers could hold if nothing else were there.

The surface is that of the collision pieces, which is what the fingers meet in the physics. No camera, no noise, one
fixed seed; an object's grasps are found once and moved with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from thinkgrasp.checks.cloud import BlockedCloud
from thinkgrasp.contacts import smallest_friction
from thinkgrasp.geometry import invert, rotation_from_quat_wxyz, voxel_downsample
from thinkgrasp.gripper import Gripper
from thinkgrasp.sim.objects import CollisionPiece, SimObject
from thinkgrasp.types import Grasps

Float = NDArray[np.float64]

SPACING_M = 0.005
"""Between the points that stand for a surface; less than any side of a finger."""
MARGIN_M = 0.001
"""Fingers and palm are enlarged by this much against those points."""
CLEARANCE_M = 0.004
"""Room between each open finger and the contact: the least that a generator of ours leaves."""
ENGAGEMENT_M = 0.002
"""The contacts lie at least this far behind the fingertips, as generators of ours have it."""
OBSTACLE_SPACING_M = 0.007
"""The same for other objects' surfaces."""
N_SEEDS = 300
N_LINES = 160
N_TURNS = 18
"""Approaches about each contact line, all around."""
_JITTER = 0.25
"""Sine of the angle by which two of three lines at a contact lean away from its normal."""
_GAP_M = 0.0005
_CHUNK = 512
_BLOCK_M = 0.025
_KEPT_OBJECTS = 256


@dataclass(frozen=True, eq=False)
class ConvexPieces:
    """Convex pieces as half spaces: a point is inside one where normals @ point + offsets <= 0 for all its faces."""

    normals: Float
    """(F, 3) unit, outward."""
    offsets: Float
    """(F,) [m]."""
    starts: NDArray[np.intp]
    """(P,) first face of each piece."""
    triangles: tuple[Float, ...]
    """Per piece, (T, 3, 3) corners [m]."""
    triangle_normals: tuple[Float, ...]
    """Per piece, (T, 3)."""

    @classmethod
    def of(cls, pieces: tuple[CollisionPiece, ...]) -> ConvexPieces:
        """Turn an object's collision pieces, round ones as polyhedra, into half spaces."""
        normals, offsets, starts, triangles, triangle_normals = [], [], [], [], []
        first = 0
        for piece in pieces:
            points = corners(piece)
            hull = ConvexHull(points)
            faces = np.unique(hull.equations.round(7), axis=0)
            normals.append(faces[:, :3])
            offsets.append(faces[:, 3])
            starts.append(first)
            first += len(faces)
            triangles.append(points[hull.simplices])
            triangle_normals.append(hull.equations[:, :3])
        return cls(
            np.concatenate(normals),
            np.concatenate(offsets),
            np.array(starts, np.intp),
            tuple(triangles),
            tuple(triangle_normals),
        )

    def depth(self, points: Float) -> Float:
        """Return how deep (P, M) [m] points (M, 3) lie inside each piece; negative outside."""
        return -np.maximum.reduceat(self.normals @ points.T + self.offsets[:, None], self.starts, axis=0)

    def crossings(self, origins: Float, directions: Float) -> tuple[Float, Float, NDArray[np.intp]]:
        """Return where lines (M) enter and leave each piece, (P, M) [m], and the face (P, M) where they leave.

        A piece that a line misses is entered at +inf and left at -inf.
        """
        along = self.normals @ directions.T
        height = self.normals @ origins.T + self.offsets[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -height / along
        aside = np.abs(along) < 1e-9
        outside = np.where(height > 1e-9, np.inf, -np.inf)
        lower = np.where(aside, outside, np.where(along < 0, t, -np.inf))
        upper = np.where(aside | (along < 0), np.inf, t)
        enter = np.maximum.reduceat(lower, self.starts, axis=0)
        leave = np.minimum.reduceat(upper, self.starts, axis=0)
        ends = np.append(self.starts[1:], len(self.normals))
        face = np.stack([a + upper[a:b].argmin(axis=0) for a, b in zip(self.starts, ends, strict=True)])
        missed = enter >= leave
        return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave), face


def corners(piece: CollisionPiece) -> Float:
    """Return points (N, 3) [m], object frame, whose convex hull is the piece; round ones as polyhedra inside it."""
    if piece.points_m is not None:
        return np.asarray(piece.points_m, np.float64)
    size = piece.size_m
    if piece.shape == "box":
        local = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    elif piece.shape == "cylinder":
        angle = np.arange(36) * np.pi / 18
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        local = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in (-size[1], size[1])])
    elif piece.shape == "capsule":
        local = size[0] * _sphere()
        local = local + np.where(local[:, 2:] >= 0, 1.0, -1.0) * np.array([0.0, 0.0, size[1]])
    else:
        local = _sphere() * (size if piece.shape == "ellipsoid" else size[0])
    return local @ rotation_from_quat_wxyz(np.array(piece.quat_wxyz)).T + np.array(piece.position_m)


def _sphere(n: int = 160) -> Float:
    """(n, 3) unit vectors on a Fibonacci spiral."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


@lru_cache(maxsize=_KEPT_OBJECTS)
def _pieces(obj: SimObject) -> ConvexPieces:
    return ConvexPieces.of(obj.collisions)


def _sampled(pieces: ConvexPieces, counts: list[int], rng: np.random.Generator) -> tuple[Float, Float]:
    """Points (M, 3) and outward normals on the union's surface, so many tried on each piece."""
    points, normals = [], []
    for triangles, normal, n in zip(pieces.triangles, pieces.triangle_normals, counts, strict=True):
        area = _areas(triangles)
        chosen = rng.choice(len(area), n, p=area / area.sum())
        a, b = np.sort(rng.uniform(size=(2, n)), axis=0)
        weights = np.stack([a, b - a, 1 - b], axis=1)
        points.append(np.einsum("nc,ncj->nj", weights, triangles[chosen]))
        normals.append(normal[chosen])
    all_points, all_normals = np.concatenate(points), np.concatenate(normals)
    outer = (pieces.depth(all_points) < _GAP_M).all(axis=0)
    return all_points[outer], all_normals[outer]


def _areas(triangles: Float) -> Float:
    sides = triangles[:, 1:] - triangles[:, :1]
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2


@lru_cache(maxsize=_KEPT_OBJECTS)
def surface_points(obj: SimObject) -> NDArray[np.float32]:
    """Return points (M, 3) [m] all over an object's collision surface, about SPACING_M apart, object frame."""
    pieces = _pieces(obj)
    counts = [int(4 * _areas(t).sum() / SPACING_M**2) + 8 for t in pieces.triangles]
    points = _sampled(pieces, counts, np.random.default_rng(0))[0]
    return points[voxel_downsample(points, SPACING_M)].astype(np.float32)


@dataclass(frozen=True, eq=False)
class TrueGrasps:
    """Grasps on one object that its own shape allows, in its frame, in random order.

    The gripper may be pushed in until its tips are `reach` past the middle between the contacts.
    """

    rotations: Float
    """(C, 3, 3) grasp frame: +z approach, +x closing."""
    middles: Float
    """(C, 3) between the two contacts [m]."""
    widths: Float
    """(C,) opening [m]."""
    reach: Float
    """(C,) [m]."""

    def __len__(self) -> int:
        return len(self.widths)

    def __getitem__(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> TrueGrasps:
        return TrueGrasps(self.rotations[index], self.middles[index], self.widths[index], self.reach[index])

    def moved(self, T: Float) -> TrueGrasps:
        """Return the grasps of the object moved by T (4, 4)."""
        R = T[:3, :3]
        return TrueGrasps(R @ self.rotations, self.middles @ R.T + T[:3, 3], self.widths, self.reach)


@lru_cache(maxsize=_KEPT_OBJECTS)
def grasps_on(obj: SimObject, gripper: Gripper) -> TrueGrasps:
    """Find antipodal grasps all over an object's collision surface.

    Contact pairs close at the object's own friction [Nguyen 1988]: a point of the surface, and where a line from it
    leaves the first wall, or the whole object. The gripper is turned about each line; it opens just as wide as the
    contacts and their clearance need or, where the object bulges beside them, all the way.
    """
    rng = np.random.default_rng(0)
    a, b = _contact_pairs(obj, gripper.max_width_m - 2 * CLEARANCE_M, rng)
    distance = np.linalg.norm(b - a, axis=1)
    closing = (b - a) / distance[:, None]
    side = np.eye(3)[np.abs(closing).argmin(axis=1)]
    side = np.cross(closing, side)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    turn = np.arange(N_TURNS) * 2 * np.pi / N_TURNS
    approach = np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * np.cross(closing, side)[:, None]
    x = np.repeat(closing, N_TURNS, axis=0)
    z = approach.reshape(-1, 3)
    rotations = np.stack([x, np.cross(z, x), z], axis=-1)
    middles = np.repeat((a + b) / 2, N_TURNS, axis=0)
    widths = np.repeat(np.maximum(distance + 2 * CLEARANCE_M, gripper.min_width_m), N_TURNS)
    found = TrueGrasps(rotations, middles, widths, np.full(len(widths), np.inf))
    own = surface_points(obj)
    reach = reach_past(found, gripper, own)
    tight = reach < ENGAGEMENT_M
    wide = TrueGrasps(rotations[tight], middles[tight], np.full(tight.sum(), gripper.max_width_m), reach[tight])
    widths[tight] = gripper.max_width_m
    reach[tight] = reach_past(wide, gripper, own)
    order = rng.permutation(np.flatnonzero(reach >= ENGAGEMENT_M))
    return TrueGrasps(rotations, middles, widths, reach)[order]


def _contact_pairs(obj: SimObject, longest_m: float, rng: np.random.Generator) -> tuple[Float, Float]:
    """Return pairs of contacts (L, 3), (L, 3) on an object's surface that close at its friction."""
    pieces = _pieces(obj)
    share = np.sqrt([_areas(t).sum() for t in pieces.triangles])
    points, normals = _sampled(pieces, np.ceil(6 * N_SEEDS * share / share.sum()).astype(int).tolist(), rng)
    side = np.abs(normals).argmax(axis=1) * 2 + (normals.sum(axis=1) > 0)
    weight = 1 / np.bincount(side)[side]  # narrow sides as often as broad ones
    chosen = rng.choice(len(points), min(N_SEEDS, len(points)), replace=False, p=weight / weight.sum())
    origins, outward = np.repeat(points[chosen], 3, axis=0), np.repeat(normals[chosen], 3, axis=0)
    lean = rng.standard_normal(origins.shape)
    lean -= (lean * outward).sum(axis=1, keepdims=True) * outward
    lean *= _JITTER * (np.arange(len(lean)) % 3 > 0)[:, None] / np.linalg.norm(lean, axis=1, keepdims=True)
    directions = lean - outward
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    enter, leave, face = pieces.crossings(origins, directions)
    wall = np.full(len(origins), _GAP_M)
    for _ in range(len(pieces.starts)):
        further = np.where(enter <= wall + _GAP_M, leave, -np.inf).max(axis=0)
        if (further <= wall).all():
            break
        wall = np.maximum(wall, further)
    first, second, outward_a, outward_b = [], [], [], []
    for end in (wall, leave.max(axis=0)):
        piece = np.abs(leave - end).argmin(axis=0)
        first.append(origins)
        second.append(origins + end[:, None] * directions)
        outward_a.append(outward)
        outward_b.append(pieces.normals[face[piece, np.arange(len(end))]])
    a, b = np.concatenate(first), np.concatenate(second)
    friction = smallest_friction(a, b, np.concatenate(outward_a), np.concatenate(outward_b))
    distance = np.linalg.norm(b - a, axis=1)
    good = np.flatnonzero((friction <= obj.friction) & (distance <= longest_m) & (distance > 2 * _GAP_M))
    good = rng.permutation(good)[:N_LINES]
    return a[good], b[good]


def reach_past(grasps: TrueGrasps, gripper: Gripper, points: NDArray[np.float32]) -> Float:
    """Return how far (C,) [m] the tips may go past the middle of each grasp before fingers or palm meet any point.

    The way in has no end; infinite where no point (M, 3), in the grasps' frame, is in the way at all.
    """
    reach = np.full(len(grasps), np.inf)
    t, breadth = gripper.finger_thickness_m + MARGIN_M, gripper.finger_breadth_m / 2 + MARGIN_M
    px, py = (side / 2 + MARGIN_M for side in gripper.palm_size_m[:2])
    for first in range(0, len(grasps), _CHUNK):
        rows = slice(first, first + _CHUNK)
        R, m = grasps.rotations[rows].astype(np.float32), grasps.middles[rows].astype(np.float32)
        x, y, z = (points @ R[:, :, i].T - np.einsum("ki,ki->k", R[:, :, i], m) for i in range(3))
        x, y = np.abs(x), np.abs(y)
        half = (grasps.widths[rows] / 2).astype(np.float32)
        finger = (x > half - MARGIN_M) & (x < half + t) & (y < breadth)
        palm = (x < px) & (y < py)
        limit = np.minimum(np.where(finger, z, np.inf), np.where(palm, z + gripper.finger_length_m, np.inf))
        reach[rows] = limit.min(axis=0, initial=np.inf) - MARGIN_M
    return reach


def reach_beside(
    grasps: TrueGrasps, depth_m: Float, gripper: Gripper, obj: SimObject, T_obj: Float, standoff_m: float
) -> Float:
    """Return how far (C,) [m] the tips may go past the middle before fingers or palm meet another object on their way.

    Args:
        grasps: In the world.
        depth_m: (C,) how far they want to go.
        gripper: Gives fingers and palm.
        obj: What may be in the way.
        T_obj: Its T_world_object (4, 4).
        standoff_m: Length of the straight way in.

    Returns:
        Infinite where the object is not in the way.
    """
    whole = np.full(len(grasps), np.inf)
    swept_m = gripper.finger_length_m + gripper.palm_size_m[2] + standoff_m
    centre, radius = bounding_sphere(obj)
    away = T_obj[:3, :3] @ centre + T_obj[:3, 3] - grasps.middles
    axis = grasps.rotations[:, :, 2]
    along = np.clip((away * axis).sum(axis=1), -swept_m, depth_m)
    near = np.linalg.norm(away - along[:, None] * axis, axis=1) < radius + _girth(gripper)
    if not near.any():
        return whole
    grasps, depth_m = grasps[near], depth_m[near]
    reach = np.full(len(grasps), np.inf)
    local = grasps.moved(invert(T_obj))
    poses = Grasps(
        local.rotations.astype(np.float32),
        local.middles.astype(np.float32),
        local.widths.astype(np.float32),
        np.ones(len(local), np.float32),
    )
    boxes = np.repeat(gripper.bodies(0.0)[None], len(grasps), axis=0)
    boxes[:, 0, :, 0] -= grasps.widths[:, None] / 2
    boxes[:, 1, :, 0] += grasps.widths[:, None] / 2
    boxes[:, :, 0, 2] -= standoff_m
    boxes[:, :, 0] -= MARGIN_M
    boxes[:, :, 1] += MARGIN_M
    boxes[:, :, 1, 2] += depth_m[:, None]
    cloud = _blocks(obj)
    for body in range(3):
        which, at = cloud.inside(poses, boxes[:, body, 0], boxes[:, body, 1])
        tip = at[:, 2] + (gripper.finger_length_m if body == 2 else 0.0) - MARGIN_M
        np.minimum.at(reach, which, tip)
    whole[near] = reach
    return whole


def _girth(gripper: Gripper) -> float:
    """How far fingers and palm are from the approach axis at most [m]."""
    fingers = gripper.max_width_m / 2 + gripper.finger_thickness_m, gripper.finger_breadth_m / 2
    return float(max(np.hypot(*fingers), np.hypot(*gripper.palm_size_m[:2]) / 2)) + MARGIN_M


@lru_cache(maxsize=_KEPT_OBJECTS)
def bounding_sphere(obj: SimObject) -> tuple[Float, float]:
    """Return centre (3,) and radius [m] of a sphere around an object's surface, object frame."""
    points = surface_points(obj).astype(np.float64)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


@lru_cache(maxsize=_KEPT_OBJECTS)
def _blocks(obj: SimObject) -> BlockedCloud:
    points = surface_points(obj)
    return BlockedCloud.of(points[voxel_downsample(points, OBSTACLE_SPACING_M)], _BLOCK_M)
