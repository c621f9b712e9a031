"""Over-segmentation: small patches of one surface and one colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from thinkgrasp.types import Array, Mask

ROUNDS = 4


def superpixels(mask: Mask, points: Array, normals: Array, lab: Array, spacing_px: int = 10) -> NDArray[np.int32]:
    """Cut the masked pixels into patches by local k-means over position, normal and colour.

    Args:
        mask: (H, W) pixels to cut; they have depth.
        points: (H, W, 3) [m].
        normals: (H, W, 3) unit; NaN counts as unknown.
        lab: (H, W, 3) CIE Lab.
        spacing_px: Size of a patch.

    Returns:
        (H, W) int32 labels 1..n, 0 outside the mask; every label is one connected patch.

    References:
        Achanta et al., SLIC superpixels, PAMI 2012: k-means with each pixel compared to its 9 nearest seeds only.
    """
    v, u = np.nonzero(mask)
    if len(u) == 0:
        return np.zeros(mask.shape, np.int32)
    z = points[v, u, 2]
    pixel_m = np.median(z) / max(mask.shape) * spacing_px
    features = np.concatenate(
        [
            np.stack([u, v], axis=1) / spacing_px * 0.7,
            (points[v, u] / (2.0 * pixel_m)),
            np.nan_to_num(normals[v, u]) * 1.5,
            lab[v, u] / 18.0,
        ],
        axis=1,
    ).astype(np.float32)
    rows, columns = -(-mask.shape[0] // spacing_px) + 2, -(-mask.shape[1] // spacing_px) + 2
    home = (v // spacing_px + 1) * columns + u // spacing_px + 1
    offsets = np.array([di * columns + dj for di in (-1, 0, 1) for dj in (-1, 0, 1)])
    n = rows * columns
    label = home
    for _ in range(ROUNDS):
        label = _nearest_seed(features, home, _means(features, label, n), offsets)
    image = np.zeros(mask.shape, np.int64)
    image[v, u] = label + 1
    return _connected_patches(image)


def _means(features: Array, label: NDArray[np.integer], n: int) -> Array:
    """Mean feature (n, F) of every label; infinite where there is none."""
    count = np.bincount(label, minlength=n)
    total = np.stack([np.bincount(label, f, minlength=n) for f in features.T], axis=1)
    means = (total / np.maximum(count, 1)[:, None]).astype(np.float32)
    means[count == 0] = np.inf
    return means


def _nearest_seed(
    features: Array, home: NDArray[np.integer], centers: Array, offsets: NDArray[np.integer]
) -> NDArray[np.integer]:
    """Label (N,) of the nearest of the seeds around each pixel's home."""
    best = np.full(len(home), np.inf, np.float32)
    label = home.copy()
    for offset in offsets:
        seed = home + offset
        d = features - centers[seed]
        distance = np.einsum("ij,ij->i", d, d)
        closer = distance < best
        best[closer] = distance[closer]
        label[closer] = seed[closer]
    return label


def _connected_patches(image: NDArray[np.int64]) -> NDArray[np.int32]:
    """Relabel so that each label is one 4-connected patch; crumbs join the patch around them."""
    patches = _label_equal(image)
    sizes = np.bincount(patches.ravel())
    crumbs = (sizes[patches] < 12) & (patches > 0)
    if crumbs.any():
        solid = np.where(crumbs, 0, patches)
        grown = ndimage.grey_dilation(solid, size=(5, 5))
        patches = np.where(crumbs & (grown > 0), grown, patches)
        patches = _label_equal(patches)
    return patches


def _label_equal(image: NDArray[np.integer]) -> NDArray[np.int32]:
    """Label the 4-connected areas of equal non-zero value, 1..n."""
    used = image > 0
    index = np.cumsum(used.ravel()).reshape(image.shape) - 1
    n = int(used.sum())
    same_h = (image[:, 1:] == image[:, :-1]) & used[:, 1:]
    same_v = (image[1:] == image[:-1]) & used[1:]
    a = np.concatenate([index[:, 1:][same_h], index[1:][same_v]])
    b = np.concatenate([index[:, :-1][same_h], index[:-1][same_v]])
    _, component = connected_components(coo_matrix((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    out = np.zeros(image.shape, np.int32)
    out[used] = component + 1
    return out
