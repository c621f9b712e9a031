"""What the simulator knows and no camera tells: which object each pixel shows, its part, how much of it is hidden."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, invert
from thinkgrasp.sim.rays import cast
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import World
from thinkgrasp.types import Mask

_ALONE_GROUP = 5
"""A geom group that nothing else uses."""


def true_labels(world: World, view: CameraView) -> NDArray[np.int32]:
    """Return the index of the object seen at each pixel (H, W), -1 = none."""
    return labels_of_geoms(world, _geoms(world, view))


def labels_of_geoms(world: World, geoms: NDArray[np.int32]) -> NDArray[np.int32]:
    """Turn geom ids of any shape, as in `Rendering.geoms`, into object indices, -1 = none."""
    return np.where(geoms >= 0, world.object_of_geom[geoms], -1).astype(np.int32)


def true_parts(world: World, view: CameraView, index: int) -> dict[str, Mask]:
    """Return the visible pixels (H, W) of each part of one object; a hidden part has an empty mask.

    Raises:
        InputError: No such object.
    """
    _check(world, index)
    geoms = _geoms(world, view)
    masks = {part: np.zeros(geoms.shape, bool) for part in world.objects[index].parts}
    for geom in np.flatnonzero(world.object_of_geom == index).tolist():
        if geom in world.visuals:
            masks[world.visuals[geom].part] |= geoms == geom
    return masks


def visible_fraction(world: World, view: CameraView, index: int) -> float:
    """Return the share 0..1 of an object's pixels that nothing hides; 0 when it is outside the image.

    The whole is what the object would cover in this image if it were the only thing in the world.

    Raises:
        InputError: No such object.
    """
    _check(world, index)
    rays = view.rays[_window(world, view, index)]
    own = np.array([g for g in world.visuals if world.object_of_geom[g] == index])
    with _moved_to(world, own, _ALONE_GROUP):
        alone = cast(world.model, world.data, view.eye, rays, groups=(_ALONE_GROUP,))
        at = np.flatnonzero(alone.geoms >= 0)
        if len(at) == 0:
            return 0.0
        others = cast(world.model, world.data, view.eye, rays[at])
    hidden = (others.geoms >= 0) & (others.distances < alone.distances[at])
    return 1.0 - float(np.count_nonzero(hidden)) / len(at)


def visible_fractions(world: World, view: CameraView) -> NDArray[np.float64]:
    """Return `visible_fraction` of every object, (N,)."""
    return np.array([visible_fraction(world, view, i) for i in range(len(world.objects))])


def _geoms(world: World, view: CameraView) -> NDArray[np.int32]:
    size = (view.intrinsics.height, view.intrinsics.width)
    return world.hits(view).geoms.reshape(size)


def _check(world: World, index: int) -> None:
    if not 0 <= index < len(world.objects):
        raise InputError(f"no object {index}; this world has objects 0..{len(world.objects) - 1}")


def _window(world: World, view: CameraView, index: int) -> NDArray[np.intp]:
    """Flat indices of the pixels that can see the object's bounding box."""
    c = view.intrinsics
    corners = np.array(list(product(*world.objects[index].bounds_m.T)))
    corners = apply(invert(view.T_world_camera) @ world.pose(index), corners)
    low, high = np.zeros(2, int), np.array([c.width, c.height])
    if (corners[:, 2] > 0.01).all():
        uv = c.project(corners)
        low = np.clip(np.floor(uv.min(axis=0)), 0, high).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, high).astype(int)
    rows, columns = np.arange(low[1], high[1]), np.arange(low[0], high[0])
    return (rows[:, None] * c.width + columns).ravel()


@contextmanager
def _moved_to(world: World, geoms: NDArray[np.intp], group: int) -> Iterator[None]:
    before = world.model.geom_group[geoms].copy()
    world.model.geom_group[geoms] = group
    try:
        yield
    finally:
        world.model.geom_group[geoms] = before
