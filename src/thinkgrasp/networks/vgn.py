"""The Volumetric Grasping Network: a grasp for every voxel of a TSDF, and which of them to believe.

Written from the paper and from the behaviour of the published code; the file `vgn_conv.pth` of its authors loads as it
is. Code and weights of the authors: BSD 3-Clause, Copyright (c) 2020, ETHZ ASL. No weights come with this package.

The cube's own frame, *task*: origin at a lower corner, z up, against gravity. The hand's frame here is the authors':
origin in the middle of the palm between the roots of the fingers, +z approach, +y closing, fingertips at z = 0.05 m.

References:
    Breyer et al., Volumetric Grasping Network: Real-time 6 DOF Grasp Detection in Clutter, CoRL 2020, arXiv 2101.01132.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from thinkgrasp.errors import InputError
from thinkgrasp.networks.checkpoint import load_strictly, read_checkpoint, ready
from thinkgrasp.networks.tsdf import fuse
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float32]
Variant = Literal["corl2020", "devel"]

RESOLUTION = 40
"""Voxels per side of the cube."""
CUBE_M = 0.30
"""Side of the cube that the network was trained on."""
SUPPORT_M = 0.05
"""Height of the support in that cube."""
HAND_OPENING_M, HAND_DEPTH_M = 0.08, 0.05
"""Widest opening and length of the fingers that it was trained with: the Franka Emika Panda's hand."""
THRESHOLD = 0.90
WIDTH_VOXELS = (1.33, 9.33)
"""Widths that the published code believes; the later branch asks no more."""
_WHAT = "VGN"
_BATCH = 4
"""Cubes at a time: more are no faster on a CPU, and need the memory."""


class Vgn(nn.Module):
    """The network; names and shapes of its state dict are those of the published weights."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = _Convolutions((1, 16, 5), (16, 32, 3), (32, 64, 3), stride=2)
        self.decoder = _Convolutions((64, 64, 3), (64, 32, 3), (32, 16, 5), stride=1)
        self.conv_qual, self.conv_rot, self.conv_width = (nn.Conv3d(16, n, 5, padding=2) for n in (1, 4, 1))

    def forward(self, grid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return quality (B, 1, N, N, N) 0..1, unit quaternion x, y, z, w (B, 4, ...) and width [voxels] (B, 1, ...).

        Args:
            grid: (B, 1, 40, 40, 40) float32, axes x, y, z of the task frame; see `Tsdf.grid`.
        """
        x = grid
        sizes: list[int] = []
        for conv in self.encoder.in_order():
            sizes.append(x.shape[-1])
            x = functional.relu(conv(x))
        for conv in self.decoder.in_order():
            x = functional.interpolate(functional.relu(conv(x)), size=(sizes.pop(),) * 3)
        heads = (self.conv_qual, self.conv_rot, self.conv_width)
        weight, bias = torch.cat([h.weight for h in heads]), torch.cat([h.bias for h in heads if h.bias is not None])
        quality, rotation, width = functional.conv3d(x, weight, bias, padding=2).split((1, 4, 1), dim=1)
        length = rotation.square().sum(dim=1, keepdim=True).sqrt().clamp_min(1e-12)
        return torch.sigmoid(quality), rotation / length, width


class _Convolutions(nn.Module):
    """Three convolutions, each (channels in, channels out, kernel)."""

    def __init__(self, *shapes: tuple[int, int, int], stride: int) -> None:
        super().__init__()
        self.conv1, self.conv2, self.conv3 = (nn.Conv3d(i, o, k, stride, k // 2) for i, o, k in shapes)

    def in_order(self) -> tuple[nn.Conv3d, nn.Conv3d, nn.Conv3d]:
        return self.conv1, self.conv2, self.conv3


@dataclass(frozen=True, eq=False)
class Prediction:
    """The network's raw answer for one cube."""

    quality: Float
    """(N, N, N) 0..1."""
    rotation_xyzw: Float
    """(4, N, N, N) unit quaternion, task from hand."""
    width_voxels: Float
    """(N, N, N) opening after closing on the object [voxels]; can be absurd away from objects."""


@dataclass(frozen=True, eq=False)
class Voxels:
    """Voxels that are believed to hold a grasp, in C order of their index."""

    index: NDArray[np.intp]
    """(K, 3)."""
    score: Float
    """(K,) processed quality."""
    quat_xyzw: Float
    """(K, 4) task from hand."""
    width_voxels: Float
    """(K,)."""

    def position_m(self, cube_m: float = CUBE_M, *, centring: bool = True) -> NDArray[np.float64]:
        """Return the palm's origin (K, 3) in the task frame [m].

        Args:
            cube_m: Side of the cube.
            centring: Add half a voxel in x and y. The published code does not, and is 3 to 4 mm off there.
        """
        half = np.array([0.5, 0.5, 0.0]) if centring else np.zeros(3)
        return np.asarray((self.index + half) * (cube_m / RESOLUTION), np.float64)

    def width_m(self, cube_m: float = CUBE_M) -> NDArray[np.float64]:
        """Return the width (K,) [m]."""
        return self.width_voxels.astype(np.float64) * (cube_m / RESOLUTION)


@dataclass(frozen=True, eq=False)
class Detection:
    """Every intermediate result from depth views to grasps in one cube."""

    grid: Float
    weight: Float
    raw: Prediction
    valid: NDArray[np.bool_]
    quality: Float
    """(N, N, N) processed."""
    voxels: Voxels


def load_vgn(weights: str | Path, device: torch.device | str = "cpu") -> Vgn:
    """Return the network with the weights of a file, ready to predict.

    Raises:
        ConfigError: The file is missing, or is not this network's.
    """
    network = Vgn()
    load_strictly(network, read_checkpoint(weights, what=_WHAT), what=_WHAT)
    return ready(network, device)


def predict(network: Vgn, grids: Float) -> list[Prediction]:
    """Run the network on cubes (B, 40, 40, 40), as `Tsdf.grid` returns them.

    Raises:
        InputError: The cubes have another shape.
    """
    if grids.ndim != 4 or grids.shape[1:] != (RESOLUTION,) * 3:
        raise InputError(f"VGN looks at cubes (B, {RESOLUTION}, {RESOLUTION}, {RESOLUTION}), got {grids.shape}")
    device = network.conv_qual.weight.device
    found: list[Prediction] = []
    with torch.inference_mode():
        for cubes in torch.from_numpy(np.ascontiguousarray(grids, np.float32))[:, None].split(_BATCH):
            parts = [t.cpu().numpy() for t in network(cubes.to(device))]
            found += [Prediction(q[0], r, w[0]) for q, r, w in zip(*parts, strict=True)]
    return found


def valid_voxels(grid: Float) -> NDArray[np.bool_]:
    """Return (N, N, N) True on the seen, free side of surfaces, and up to two voxels from it into what is unseen."""
    outside, inside = grid > 0.5, (grid > 1e-3) & (grid < 0.5)
    return np.asarray(ndimage.binary_dilation(outside, iterations=2, mask=~inside), np.bool_)


def process_quality(grid: Float, raw: Prediction, *, variant: Variant = "corl2020") -> Float:
    """Return the quality (N, N, N), smoothed, and 0 where no grasp can be.

    Args:
        grid: What the network saw.
        raw: Its answer.
        variant: "corl2020", the published code, also leaves out widths outside `WIDTH_VOXELS`; "devel" does not.
    """
    quality = np.asarray(ndimage.gaussian_filter(raw.quality, sigma=1.0, mode="nearest", radius=4), np.float32)
    quality[~valid_voxels(grid)] = 0
    if variant == "corl2020":
        low, high = WIDTH_VOXELS
        quality[(raw.width_voxels < low) | (raw.width_voxels > high)] = 0
    return quality


def select_voxels(
    quality: Float,
    raw: Prediction,
    *,
    variant: Variant = "corl2020",
    threshold: float = THRESHOLD,
    only_maxima: bool = True,
) -> Voxels:
    """Return the voxels worth a grasp.

    Args:
        quality: As `process_quality` returns it.
        raw: Rotation and width are read from it.
        variant: "corl2020" asks for a maximum within offsets -2..+1 and at least the threshold; "devel" for a maximum
            within -1..+1 and more than the threshold.
        threshold: Least processed quality.
        only_maxima: False keeps neighbours too.
    """
    good = quality >= threshold if variant == "corl2020" else quality > threshold
    if only_maxima:
        candidates = np.where(good, quality, np.float32(0)) if variant == "corl2020" else quality
        good &= candidates == ndimage.maximum_filter(candidates, size=4 if variant == "corl2020" else 3)
    index = np.argwhere(good & (quality > 0))
    i, j, k = index.T
    return Voxels(index, quality[i, j, k], raw.rotation_xyzw[:, i, j, k].T, raw.width_voxels[i, j, k])


def detect(
    network: Vgn,
    depth: NDArray[np.floating],
    cameras: CameraIntrinsics | Sequence[CameraIntrinsics],
    T_camera_task: NDArray[np.floating],
    *,
    variant: Variant = "corl2020",
    threshold: float = THRESHOLD,
    cube_m: float = CUBE_M,
) -> Detection:
    """Go from depth views to grasps in one cube, keeping every intermediate result.

    Args:
        network: As `load_vgn` returns it.
        depth: (V, H, W) [m]; 0 or NaN = no return.
        cameras: One for all views, or one each.
        T_camera_task: Cube to camera, (V, 4, 4).
        variant: Which post-processing.
        threshold: Least processed quality.
        cube_m: Side of the cube.
    """
    field = fuse(depth, cameras, T_camera_task, length_m=cube_m, resolution=RESOLUTION)
    grid = field.grid()
    (raw,) = predict(network, grid[None])
    quality = process_quality(grid, raw, variant=variant)
    voxels = select_voxels(quality, raw, variant=variant, threshold=threshold)
    return Detection(grid, field.weights, raw, valid_voxels(grid), quality, voxels)
