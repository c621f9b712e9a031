"""Over-segmentation: small patches of one surface and one colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.types import Array, Mask


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
    label = home
    n = rows * columns
    for _ in range(4):
        count = np.bincount(label, minlength=n).astype(np.float32)
        centers = np.stack([np.bincount(label, f, minlength=n) for f in features.T], axis=1)
        centers = (centers / np.maximum(count, 1)[:, None]).astype(np.float32)
        centers[count == 0] = np.inf
        best = np.full(len(u), np.inf, np.float32)
        label = home.copy()
        for offset in offsets:
            seed = home + offset
            d = features - centers[seed]
            distance = np.einsum("ij,ij->i", d, d)
            closer = distance < best
            best = np.where(closer, distance, best)
            label = np.where(closer, seed, label)
    image = np.zeros(mask.shape, np.int64)
    image[v, u] = label + 1
    return _connected_patches(image)


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
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    index = np.arange(image.size).reshape(image.shape)
    same_h = (image[:, 1:] == image[:, :-1]) & (image[:, 1:] > 0)
    same_v = (image[1:] == image[:-1]) & (image[1:] > 0)
    a = np.concatenate([index[:, 1:][same_h], index[1:][same_v]])
    b = np.concatenate([index[:, :-1][same_h], index[:-1][same_v]])
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(image.size, image.size))
    _, component = connected_components(graph, directed=False)
    flat = component[image.ravel() > 0]
    out = np.zeros(image.size, np.int32)
    out[image.ravel() > 0] = np.unique(flat, return_inverse=True)[1] + 1
    return out.reshape(image.shape)
