"""PointNet++ layers and the backbone of the grasp networks: 1024 seed points with 256 features each.

Modules carry the names of the official state dicts; for inference, batch normalisation is folded into the layer before
it, features are kept one row per point, and groups are worked off in blocks that fit the processor's cache.

References:
    Qi et al., PointNet++, NeurIPS 2017; Fang et al., GraspNet-1Billion, CVPR 2020. Checked against the official modules
    of graspnet-baseline (commit 280c215) by golden data; the code is our own.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from thinkgrasp.networks.point_queries import ball_query, furthest_points, three_nearest

ROWS_PER_BLOCK = 8192
"""So many rows of features are computed at a time: bounds memory, and stays in the cache."""


def folded(layer: nn.Conv1d | nn.Conv2d, norm: nn.BatchNorm1d | nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Return weight (out, in) and bias (out,) of a 1x1 convolution followed by this normalisation, as one layer."""
    mean, variance = cast(Tensor, norm.running_mean), cast(Tensor, norm.running_var)
    scale = norm.weight / torch.sqrt(variance + norm.eps)
    bias = norm.bias - mean * scale
    if layer.bias is not None:
        bias = bias + layer.bias * scale
    return layer.weight.flatten(1) * scale[:, None], bias


class _Layer(nn.Module):
    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(n_in, n_out, 1, bias=False)
        self.bn = nn.Sequential(OrderedDict(bn=nn.BatchNorm2d(n_out)))

    def folded(self) -> tuple[Tensor, Tensor]:
        return folded(self.conv, cast(nn.BatchNorm2d, self.bn[0]))


class SharedMLP(nn.Module):
    """Layers of 1x1 convolution, batch normalisation and ReLU, the same for every point.

    Args:
        widths: Channels of the input and of each layer.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        for i, (n_in, n_out) in enumerate(pairwise(widths)):
            self.add_module(f"layer{i}", _Layer(n_in, n_out))

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Return weight (out, in) and bias (out,) of every layer, normalisation folded in."""
        return [layer.folded() for layer in self.children() if isinstance(layer, _Layer)]


def through(rows: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Pass rows (R, C) through layers with ReLU after each."""
    for weight, bias in layers:
        rows = torch.addmm(bias, rows, weight.T).relu_()
    return rows


class GroupMLP:
    """A shared MLP over groups whose rows are offsets (3) and, after them, features of the grouped points.

    The first layer is linear, so its part that belongs to the features is computed once for each point instead of once
    for each of the groups that the point is in.

    Args:
        mlp: Its first 3 input channels are the offsets.
        features: (N, C) of all points, or None where offsets are all there is.
    """

    def __init__(self, mlp: SharedMLP, features: Tensor | None) -> None:
        (weight, bias), *self._rest = mlp.layers()
        self._offset_weight = weight[:, :3].T.contiguous()
        self._base = bias if features is None else torch.addmm(bias, features, weight[:, 3:].T)
        self._shared = features is None

    def __call__(self, offsets: Tensor, index: Tensor) -> Tensor:
        """Return features (R, out) of rows with these offsets (R, 3), and features of these points (R,) if any."""
        return through(self._first(offsets, index), self._rest)

    def pooled(self, offsets: Tensor, index: Tensor, pool: Callable[[Tensor], Tensor]) -> Tensor:
        """Return `pool(self(offsets, index))` for a `pool` that takes the largest of some rows.

        Bias and ReLU of the last layer never change an order, so they are applied to what is left.
        """
        *middle, (weight, bias) = self._rest
        return pool(through(self._first(offsets, index), middle) @ weight.T).add_(bias).relu_()

    def _first(self, offsets: Tensor, index: Tensor) -> Tensor:
        base = self._base if self._shared else self._base.index_select(0, index)
        return torch.addmm(base, offsets, self._offset_weight).relu_()


@dataclass(frozen=True, eq=False)
class Level:
    """The points that one set abstraction picks."""

    inds: Tensor
    """(n,) indices into the points it was given."""
    in_order: bool
    """Picking again, from these points, would take them one after the other."""
    ball_idx: Tensor
    """(n, slots) the points grouped about each, likewise."""
    xyz: Tensor
    """(n, 3) [m]."""
    features: Tensor
    """(n, C)."""


class SetAbstraction(nn.Module):
    """Pick points, group what lies about them, and keep the largest feature of each group.

    Args:
        n_points: How many are picked.
        radius: Of the groups [m]; offsets are divided by it.
        n_samples: Slots of a group.
        widths: Channels of the MLP; the first is 3 and the features' together.
    """

    def __init__(self, n_points: int, radius: float, n_samples: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.n_points = n_points
        self.radius = radius
        self.n_samples = n_samples
        self.mlp_module = SharedMLP(widths)

    def forward(self, xyz: Tensor, features: Tensor | None, *, in_order: bool = False) -> Level:
        """Abstract points (N, 3) [m] with features (N, C), in the order of a level's picks or in any."""
        if in_order:
            inds = torch.arange(self.n_points, device=xyz.device)
        else:
            inds, in_order = furthest_points(xyz, self.n_points)
        centers = xyz[inds]
        ball_idx = ball_query(xyz, centers, self.radius, self.n_samples)
        mlp = GroupMLP(self.mlp_module, features)
        pooled: list[Tensor] = []
        per_block = ROWS_PER_BLOCK // self.n_samples
        for index, center in zip(ball_idx.split(per_block), centers.split(per_block), strict=True):
            near = xyz.index_select(0, index.flatten()).view(*index.shape, 3)
            offsets = (near - center[:, None]) / self.radius
            largest = partial(_largest, groups=len(index))
            pooled.append(mlp.pooled(offsets.flatten(0, 1), index.flatten(), largest))
        return Level(inds, in_order, ball_idx, centers, torch.cat(pooled))


def _largest(rows: Tensor, groups: int) -> Tensor:
    return rows.view(groups, -1, rows.shape[1]).amax(dim=1)


class FeaturePropagation(nn.Module):
    """Carry features from few points to more, by distance, and mix them with what those had.

    Args:
        widths: Channels of the MLP; the first is that of both features together.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.mlp = SharedMLP(widths)

    def forward(self, xyz: Tensor, features: Tensor, known: Tensor, known_features: Tensor) -> Tensor:
        """Return (N, out) for points (N, 3) with features (N, C), from known points (K, 3) with theirs (K, D)."""
        squared, index = three_nearest(xyz, known)
        weight = 1.0 / (squared.sqrt() + 1e-8)
        weight = weight / weight.sum(dim=1, keepdim=True)
        nearest = known_features.index_select(0, index.flatten()).view(*index.shape, -1)
        carried = (nearest * weight[..., None]).sum(dim=1)
        return through(torch.cat([carried, features], dim=1), self.mlp.layers())


@dataclass(frozen=True, eq=False)
class Seeds:
    """What the backbone makes of a cloud."""

    levels: tuple[Level, Level, Level, Level]
    fp1_features: Tensor
    """(512, 256)."""
    fp2_features: Tensor
    """(1024, 256), of the seeds: the points of the second level."""

    @property
    def xyz(self) -> Tensor:
        """(1024, 3) seeds [m]."""
        return self.levels[1].xyz

    @property
    def inds(self) -> Tensor:
        """(1024,) seeds as indices into the cloud."""
        return self.levels[0].inds[: len(self.xyz)]


class Backbone(nn.Module):
    """PointNet++ of the grasp networks: four abstractions down, two propagations up."""

    def __init__(self) -> None:
        super().__init__()
        self.sa1 = SetAbstraction(2048, 0.04, 64, (3, 64, 64, 128))
        self.sa2 = SetAbstraction(1024, 0.1, 32, (3 + 128, 128, 128, 256))
        self.sa3 = SetAbstraction(512, 0.2, 16, (3 + 256, 128, 128, 256))
        self.sa4 = SetAbstraction(256, 0.3, 16, (3 + 256, 128, 128, 256))
        self.fp1 = FeaturePropagation((256 + 256, 256, 256))
        self.fp2 = FeaturePropagation((256 + 256, 256, 256))

    def forward(self, cloud: Tensor) -> Seeds:
        """Find seeds in a cloud (N, 3) [m]."""
        one = self.sa1(cloud, None)
        two = self.sa2(one.xyz, one.features, in_order=one.in_order)
        three = self.sa3(two.xyz, two.features, in_order=two.in_order)
        four = self.sa4(three.xyz, three.features, in_order=three.in_order)
        fp1 = self.fp1(three.xyz, three.features, four.xyz, four.features)
        fp2 = self.fp2(two.xyz, two.features, three.xyz, fp1)
        return Seeds((one, two, three, four), fp1, fp2)
