"""Over-segmentation: small patches of one surface and one colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from thinkgrasp.types import Array, Mask

ROUNDS = 3
MANY_PIXELS = 50_000
"""More are clustered at half resolution: then the things are large."""


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
        Achanta et al., SLIC superpixels, PAMI 2012: k-means with each pixel compared to the seeds around it only; here
        the four whose cells' centres surround it.
    """
    stride = 2 if mask.sum() > MANY_PIXELS else 1
    labels = _cluster(
        mask[::stride, ::stride],
        points[::stride, ::stride],
        normals[::stride, ::stride],
        lab[::stride, ::stride],
        spacing_px // stride,
    )
    if stride > 1:
        labels = labels.repeat(stride, axis=0).repeat(stride, axis=1)[: mask.shape[0], : mask.shape[1]]
        labels = np.where(mask & (labels == 0), ndimage.grey_dilation(labels, size=(3, 3)), labels)
    return np.where(mask, labels, 0).astype(np.int32)


def _cluster(mask: Mask, points: Array, normals: Array, lab: Array, spacing_px: int) -> NDArray[np.int32]:
    """Cluster at the given resolution; arguments as above."""
    v, u = np.nonzero(mask)
    if len(u) == 0:
        return np.zeros(mask.shape, np.int32)
    p = points[v, u]
    patch_m = float(np.median(p[:, 2])) / max(mask.shape) * spacing_px
    features = np.empty((len(u), 11), np.float32)
    features[:, 0], features[:, 1] = u * (0.7 / spacing_px), v * (0.7 / spacing_px)
    features[:, 2:5] = p * np.float32(0.5 / patch_m)
    features[:, 5:8] = np.nan_to_num(normals[v, u]) * np.float32(1.5)
    features[:, 8:] = lab[v, u] * np.float32(1 / 18.0)
    columns = -(-mask.shape[1] // spacing_px) + 2
    n = (-(-mask.shape[0] // spacing_px) + 2) * columns
    home = (v // spacing_px + 1) * columns + u // spacing_px + 1
    beside = np.where(u % spacing_px < spacing_px / 2, -1, 1)
    above = np.where(v % spacing_px < spacing_px / 2, -columns, columns)
    seeds = (home, home + beside, home + above, home + beside + above)
    label = home
    for _ in range(ROUNDS):
        label = _nearest_seed(features, seeds, _means(features, label, n))
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


def _nearest_seed(features: Array, seeds: tuple[NDArray[np.integer], ...], centers: Array) -> NDArray[np.integer]:
    """Label (N,) of the nearest of the seeds around each pixel."""
    label = seeds[0].copy()
    best = np.full(len(label), np.inf, np.float32)
    for seed in seeds:
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
