"""Connected areas and nearest areas of images, with the types that scipy leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.types import Mask

Labels = NDArray[np.int32]
"""(H, W) 1..n, 0 = none."""


def connected_areas(mask: Mask, *, diagonal: bool = False) -> tuple[Labels, int]:
    """Label the connected areas of a mask (H, W), 1..n, and return the labels with n.

    Args:
        mask: (H, W).
        diagonal: Whether pixels that share only a corner are connected.
    """
    structure = np.ones((3, 3), bool) if diagonal else None
    return cast("tuple[Labels, int]", ndimage.label(mask, structure=structure))


@dataclass(frozen=True, eq=False)
class Nearest:
    """The labelled pixel that is nearest to every pixel."""

    distance_px: NDArray[np.float64]
    """(H, W)"""
    pixel: NDArray[np.intp]
    """(H, W) its flat index"""


def nearest_area(labels: Labels) -> Nearest:
    """Find the labelled pixel nearest to every pixel of (H, W)."""
    distance, where = cast(
        "tuple[NDArray[np.float64], NDArray[np.int32]]",
        ndimage.distance_transform_edt(labels == 0, return_indices=True),
    )
    return Nearest(distance, where[0].astype(np.intp) * labels.shape[1] + where[1])


def pixels_by_label(labels: Labels) -> list[NDArray[np.intp]]:
    """Return the flat indices of the pixels of every label 1..n, in image order."""
    used = np.flatnonzero(labels)
    owner = labels.ravel()[used]
    order = np.argsort(owner, kind="stable")
    ends = np.cumsum(np.bincount(owner, minlength=int(labels.max()) + 1))
    return np.split(used[order], ends[1:-1])
