"""From a box to a mask: by a model that takes boxes (SAM), or else by the scene's proposals and depth."""

from __future__ import annotations

from typing import NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.errors import ContractError
from thinkgrasp.types import Mask, Proposal, Scene

MIN_SHARE = 0.1
"""A proposal that fills less of a box than this is not what the box shows."""
DEPTH_BAND_M = 0.05
"""Without proposals and region: what lies this near in depth to the box's middle belongs together."""


class MaskBatch(Protocol):
    """What a model answers; it may hold more."""

    @property
    def masks(self) -> NDArray[np.bool_]:
        """(N, H, W)."""
        ...


class MaskModel(Protocol):
    """A model that turns boxes into masks, such as SAM."""

    def masks(self, image: NDArray[np.uint8], boxes: NDArray[np.float32]) -> MaskBatch:
        """Return one mask per box.

        Args:
            image: (H, W, 3) RGB.
            boxes: (N, 4) x0, y0, x1, y1 [px], inside the image.
        """
        ...


class BoxMask(NamedTuple):
    """A mask (H, W), the proposal it belongs to, and how it was made where no model made it."""

    mask: Mask
    mark: int | None
    fallback: str | None


def model_masks(model: MaskModel, scene: Scene, boxes_xyxy: NDArray[np.float32], fill_px: int) -> list[BoxMask]:
    """Return the model's masks, holes smaller than `fill_px` filled.

    Raises:
        ContractError: The model returned something else than (N, H, W) bool.
    """
    masks: object = getattr(model.masks(scene.frame.color, boxes_xyxy), "masks", None)
    wanted = (len(boxes_xyxy), *scene.frame.depth.shape)
    if not isinstance(masks, np.ndarray) or masks.shape != wanted or masks.dtype != np.bool_:
        got = f"{masks.shape} {masks.dtype}" if isinstance(masks, np.ndarray) else type(masks).__name__
        raise ContractError(f"{type(model).__name__}.masks must return masks {wanted} bool, got {got}")
    filled = [fill_holes(mask, fill_px) for mask in masks]
    return [BoxMask(mask, _mark(mask, scene.proposals), None) for mask in filled]


def scene_mask(scene: Scene, box_xyxy: NDArray[np.float32], preferred: Proposal | None = None) -> BoxMask:
    """Return what the scene itself knows to be in a box.

    Args:
        scene: With proposals, or else a region, or else depth alone.
        box_xyxy: (4,) [px].
        preferred: The proposal to cut, where it is in the box at all.
    """
    height, width = scene.frame.depth.shape
    x0, y0 = (np.clip(np.floor(box_xyxy[:2]), 0, [width - 1, height - 1])).astype(int)
    x1, y1 = np.maximum(np.clip(np.ceil(box_xyxy[2:]), 0, [width, height]).astype(int), [x0 + 1, y0 + 1])
    box = (slice(y0, y1), slice(x0, x1))
    inside = np.zeros((height, width), np.bool_)
    inside[box] = True
    candidates = scene.proposals if preferred is None else (preferred,)
    best = max(candidates, key=lambda p: int(p.mask[box].sum()), default=None)
    if best is not None and best.mask[box].mean() >= MIN_SHARE:
        return BoxMask(best.mask & inside, best.mark, "the part of the scene's proposal that is inside the box")
    near = _near(scene, box) & inside
    if near.any():
        return BoxMask(near, None, "what the depth says to stand out inside the box")
    return BoxMask(inside, None, "the whole box")


def fill_holes(mask: Mask, smaller_than_px: int) -> Mask:
    """Return a mask without holes (8-connected) of fewer pixels than this; islands stay."""
    holes, count = cast(tuple[NDArray[np.int32], int], ndimage.label(~mask, np.ones((3, 3), np.int8)))
    if not count:
        return mask
    small = np.bincount(holes.ravel(), minlength=count + 1) < smaller_than_px
    small[0] = False
    return mask | small[holes]


def _near(scene: Scene, box: tuple[slice, slice]) -> Mask:
    """Return (H, W): above the support where that is known, else as near as the box's middle."""
    depth = scene.frame.depth
    if scene.region is not None:
        return scene.region
    seen = depth > 0
    rows, columns = box
    middle = (_middle(rows), _middle(columns))
    values = depth[middle][seen[middle]]
    if not values.size:
        return np.zeros_like(seen)
    return seen & (np.abs(depth - np.median(values)) <= DEPTH_BAND_M)


def _middle(side: slice) -> slice:
    quarter = (side.stop - side.start) // 4
    return slice(side.start + quarter, side.stop - quarter)


def _mark(mask: Mask, proposals: tuple[Proposal, ...]) -> int | None:
    """Return the mark of the proposal that holds most of a mask, if it holds half of it."""
    best = max(proposals, key=lambda p: int((p.mask & mask).sum()), default=None)
    if best is None or 2 * (best.mask & mask).sum() < max(1, mask.sum()):
        return None
    return best.mark
