"""What a model without flaws would answer: read from the simulator's truth, for the emulator only.

It judges a picture of the world as that picture was sent: every pixel below is one of `PictureTruth.view`.
"""

# MuJoCo's bindings carry no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from thinkgrasp.sim.description import known_kind
from thinkgrasp.sim.rays import cast
from thinkgrasp.sim.render import render
from thinkgrasp.sim.truth import true_labels, true_parts
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import World
from thinkgrasp.types import BoxXYXY, CameraIntrinsics, Mask

SEEN_SHARE = 0.6
"""A thing of whose outline less is seen is to be uncovered before it is taken."""
IN_VIEW_PX = 12
"""A thing with fewer pixels is not seen at all."""
RESTS_COS = 0.5
"""Of the angle between a contact's normal and the vertical, from which on the upper thing rests on the lower one."""
MIN_PART_SHARE = 0.05
"""Of a thing's pixels that a part must have to be held by."""
UNNAMED_PARTS = frozenset({"body", "rim"})
"""Who holds a thing by one of these says only the thing."""
_ALONE_GROUP = 5
_THUMBNAIL_PX = 48


def frozen(world: World) -> World:
    """Return a copy whose state stays as it is now, with the contacts of every pair, those asleep included."""
    still = copy.copy(world)
    still.model, still.data = copy.copy(world.model), copy.copy(world.data)
    still.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    mujoco.mj_forward(still.model, still.data)
    return still


def view_of_picture(view: CameraView, size_wh: tuple[int, int]) -> CameraView:
    """Return the view whose pixels are those of a scaled picture; where the shape differs, of its centre cut out."""
    c, (w, h) = view.intrinsics, size_wh
    scale = max(w / c.width, h / c.height)
    cx, cy = (
        (centre + 0.5) * scale - 0.5 - (full * scale - part) / 2
        for centre, full, part in ((c.cx, c.width, w), (c.cy, c.height, h))
    )
    return CameraView(CameraIntrinsics(w, h, c.fx * scale, c.fy * scale, cx, cy), view.T_world_camera)


def view_that_shows(world: World, views: Sequence[CameraView], picture: NDArray[np.uint8]) -> CameraView:
    """Return which of the views a picture (h, w, 3) was taken from, whatever is drawn on it, scaled to its size."""
    h, w = picture.shape[:2]
    small = (_THUMBNAIL_PX, max(1, round(_THUMBNAIL_PX * h / w)))
    rows, columns = (np.linspace(0, n - 1, m).round().astype(int) for n, m in ((h, small[1]), (w, small[0])))
    thumbnail = picture[np.ix_(rows, columns)].astype(float)

    def difference(view: CameraView) -> float:
        seen = render(world.model, world.data, view_of_picture(view, small), world.visuals)
        return float(np.median(np.abs(seen.color - thumbnail)))

    return view_of_picture(min(views, key=difference), (w, h))


@dataclass(frozen=True)
class Spot:
    """The cell and the pixel (u, v) to take a thing by, and the part to name with it (None: the thing as a whole)."""

    cell: int
    pixel: tuple[int, int]
    part: str | None


class PictureTruth:
    """What a picture of a world truly shows, and what would have to go first to reach its goals.

    Args:
        world: At rest; see `frozen`. Geom groups change while an outline is asked for.
        view: Of the picture.
        goals: Indices of the objects that serve the instruction.
    """

    def __init__(self, world: World, view: CameraView, goals: Collection[int]) -> None:
        self._world = world
        self.view = view
        self.labels = true_labels(world, view)
        """(h, w) object index, -1 = none."""
        self._goals = tuple(goals)
        self._outlines: dict[int, Mask] = {}

    def name(self, index: int) -> str:
        """Return what a person calls an object."""
        return self._world.objects[index].name

    @cached_property
    def in_view(self) -> tuple[int, ...]:
        """Objects that are seen at all, those with most pixels first."""
        pixels = np.bincount(self.labels[self.labels >= 0], minlength=len(self._world.objects))
        return tuple(int(i) for i in np.argsort(-pixels, kind="stable") if pixels[i] >= IN_VIEW_PX)

    def box(self, index: int) -> BoxXYXY:
        """Return the box around the visible pixels of an object that is in view."""
        v, u = np.nonzero(self.labels == index)
        return int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1

    # -- what is in the way ------------------------------------------------------------------------------------------

    def outline(self, index: int) -> Mask:
        """Return the pixels (h, w) that an object would cover if it were alone."""
        if index not in self._outlines:
            groups = self._world.model.geom_group
            own = [g for g in self._world.visuals if self._world.object_of_geom[g] == index]
            before = groups[own].copy()
            groups[own] = _ALONE_GROUP
            model, data = self._world.model, self._world.data
            hits = cast(model, data, self.view.eye, self.view.rays, groups=(_ALONE_GROUP,))
            groups[own] = before
            self._outlines[index] = (hits.geoms >= 0).reshape(self.labels.shape)
        return self._outlines[index]

    def seen_share(self, index: int) -> float:
        """Return the share 0..1 of an object's outline that is seen; 0 outside of the picture."""
        outline = self.outline(index)
        return float(np.count_nonzero(outline & (self.labels == index))) / max(int(outline.sum()), 1)

    def hider(self, index: int) -> int | None:
        """Return the object whose pixels lie over most of another's outline."""
        over = self.labels[self.outline(index)]
        over = over[(over >= 0) & (over != index)]
        return int(np.bincount(over).argmax()) if len(over) else None

    @cached_property
    def _rests_on(self) -> frozenset[tuple[int, int]]:
        """Pairs of objects, the upper one first."""
        contact = self._world.data.contact
        pairs = self._world.object_of_geom[contact.geom.reshape(-1, 2)]
        up = contact.frame.reshape(-1, 9)[:, 2]  # the normal points from the first to the second
        between = (pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1]) & (np.abs(up) >= RESTS_COS)
        upper_first = np.where((up > 0)[:, None], pairs[:, ::-1], pairs)
        return frozenset((int(a), int(b)) for a, b in upper_first[between])

    def upon(self, index: int) -> tuple[int, ...]:
        """Return the objects that rest on an object, the one with most pixels first."""
        upper = {a for a, b in self._rests_on if b == index}
        return (*(i for i in self.in_view if i in upper), *sorted(upper - set(self.in_view)))

    def way_to(self, goal: int) -> tuple[int, ...]:
        """Return a goal, what rests on it or hides it, what is in the way of that, and so on; the last one is free."""
        way = [goal]
        while True:
            below = way[-1]
            in_way = list(self.upon(below))
            if self.seen_share(below) < SEEN_SHARE and (hider := self.hider(below)) is not None:
                in_way.append(hider)
            in_way = [i for i in in_way if i not in way]
            if not in_way:
                return tuple(way)
            way.append(in_way[0])

    def ways(self) -> list[tuple[int, ...]]:
        """Return `way_to` every goal that is left, the shortest first, of equals the one that is seen best."""
        left = [g for g in self._goals if self._world.on_table(g) and self.outline(g).any()]
        return sorted(map(self.way_to, left), key=lambda way: (len(way), -self.seen_share(way[0])))

    def distance_m(self, a: int, b: int) -> float:
        """Return how far apart the centres of two objects are."""
        return float(np.linalg.norm(self._world.center(a) - self._world.center(b)))

    # -- where to hold it --------------------------------------------------------------------------------------------

    def object_in(self, box: BoxXYXY) -> int | None:
        """Return the object with most pixels in a box, pixels near its centre counting most."""
        x0, y0, x1, y1 = box
        inside = self.labels[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)]
        h, w = inside.shape
        if not inside.size or not (inside >= 0).any():
            return None
        v, u = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (h, w))
        weight = np.exp(-(v[:, None] ** 2 + u**2))
        at = inside >= 0
        return int(np.bincount(inside[at], weights=weight[at]).argmax())

    def spot(self, index: int, box: BoxXYXY, grid: int, failed: Collection[int] = ()) -> Spot:
        """Return where to hold an object: a part made for it or the middle, away from what cuts or breaks.

        Args:
            index: An object that is in view.
            box: What the grid is laid over.
            grid: Cells per side.
            failed: Cells that were tried in vain.
        """
        whole = self.labels == index
        kind = known_kind(self.name(index))
        parts = {name: mask & whole for name, mask in true_parts(self._world, self.view, index).items()}
        part = next((p.name for p in (kind.take if kind else ()) if _is_seen(parts.get(p.name), whole)), None)
        region = whole if part is None else parts[part]
        avoided = [parts[p.name] for p in (kind.avoid if kind else ()) if p.name in parts]
        safe = region & ~np.logical_or.reduce(avoided) if avoided else region
        v, u = np.nonzero(safe if safe.any() else region)
        distance = np.hypot(u - u.mean(), v - v.mean()) / max(float(np.hypot(u.std(), v.std())), 1.0)
        x0, y0, x1, y1 = box
        column, row = (
            np.clip((at + 0.5 - low) / max(high - low, 1) * grid, 0, grid - 1).astype(int)
            for at, low, high in ((u, x0, x1), (v, y0, y1))
        )
        score = np.bincount(row * grid + column, weights=np.exp(-(distance**2)), minlength=grid**2)
        score[[cell - 1 for cell in failed if 1 <= cell <= grid**2]] *= 0.01
        nearest = int(distance.argmin())
        pixel = int(u[nearest]), int(v[nearest])
        return Spot(int(score.argmax()) + 1, pixel, None if part in UNNAMED_PARTS else part)


def _is_seen(part: Mask | None, whole: Mask) -> bool:
    return part is not None and int(part.sum()) >= max(MIN_PART_SHARE * int(whole.sum()), 1)
