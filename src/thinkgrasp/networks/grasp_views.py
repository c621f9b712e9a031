"""What the two grasp networks share after the backbone: views, their frames, heads, and the rows of decoded grasps.

A row holds score, width [m], height [m], depth [m], rotation (9, row-major), seed (3) [m] and an object id, -1, in the
camera's optical frame. Columns of the rotation: approach, closing direction, and x cross y along the fingers' breadth.

References:
    Fang et al., GraspNet-1Billion, CVPR 2020; graspnet-baseline (commit 280c215). The code is our own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.networks.checkpoint import load_strictly, ready
from thinkgrasp.networks.point_queries import ORIGIN_SQUARED_M
from thinkgrasp.networks.pointnet2 import Seeds, folded, through

N_VIEWS, N_ANGLES, N_DEPTHS = 300, 12, 4
MAX_WIDTH_M = 0.1
WIDTH_MARGIN = 1.2
"""The opening is this much wider than what the network measures between the fingers."""
FINGER_HEIGHT_M = 0.02
DEPTH_STEP_M = 0.01
CYLINDER_RADIUS_M, CYLINDER_LOW_M = 0.05, -0.02
MAX_COORDINATE_M = 100.0


def view_directions(count: int = N_VIEWS) -> NDArray[np.float32]:
    """Return unit directions (count, 3) from the object out to the gripper, spread evenly over the sphere.

    References:
        Fibonacci lattice; the approach is the opposite of a view.
    """
    i = np.arange(count, dtype=np.float64)
    z = (2 * i + 1) / count - 1
    radius, turn = np.sqrt(1 - z**2), 2 * np.pi * i * (np.sqrt(5) - 1) / 2
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1).astype(np.float32)


def approach_rotations(approach: Tensor, angle: Tensor) -> Tensor:
    """Return rotations (n, 3, 3) from approach directions (n, 3) and in-plane angles (n,) [rad].

    At angle 0 the closing direction lies in the image plane; along the optical axis it is the image's y.
    """
    x = approach / approach.norm(dim=1, keepdim=True)
    level = torch.stack([-approach[:, 1], approach[:, 0], torch.zeros_like(approach[:, 0])], dim=1)
    length = level.norm(dim=1, keepdim=True)
    level = torch.where(length == 0, level.new_tensor([0.0, 1.0, 0.0]), level / length)
    other = torch.linalg.cross(x, level, dim=1)
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    return torch.stack([x, cos * level + sin * other, cos * other - sin * level], dim=2)


def decoded_rows(
    score: Tensor, width: Tensor, depth_class: Tensor, angle_class: Tensor, views: Tensor, seeds: Tensor
) -> Tensor:
    """Return rows (n, 17) from scores (n,), raw widths (n,), classes (n,), views (n, 3) and seeds (n, 3)."""
    rotation = approach_rotations(-views, angle_class.to(views.dtype) / N_ANGLES * np.pi)
    width = (WIDTH_MARGIN * width).clamp(0, MAX_WIDTH_M)
    depth = (depth_class + 1).to(score.dtype) * DEPTH_STEP_M
    height, nobody = torch.full_like(score, FINGER_HEIGHT_M), torch.full_like(score, -1)
    head = torch.stack([score, width, height, depth], dim=1)
    return torch.cat([head, rotation.flatten(1), seeds, nobody[:, None]], dim=1)


class Head(nn.Module):
    """Three linear layers, the first two normalised and rectified.

    Args:
        widths: Channels of the input and of each layer.
    """

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        self.conv1 = nn.Conv1d(widths[0], widths[1], 1)
        self.conv2 = nn.Conv1d(widths[1], widths[2], 1)
        self.conv3 = nn.Conv1d(widths[2], widths[3], 1)
        self.bn1 = nn.BatchNorm1d(widths[1])
        self.bn2 = nn.BatchNorm1d(widths[2])

    def forward(self, rows: Tensor) -> Tensor:
        """Return (R, out) of rows (R, in)."""
        rows = through(rows, [folded(self.conv1, self.bn1), folded(self.conv2, self.bn2)])
        return nn.functional.linear(rows, self.conv3.weight[..., 0], self.conv3.bias)


class ApproachNet(Head):
    """Is a seed graspable, and how good is each of the 300 views of it?"""

    def __init__(self) -> None:
        super().__init__((256, 256, 2 + N_VIEWS, 2 + N_VIEWS))


@dataclass(frozen=True, eq=False)
class ViewOutput:
    """Every intermediate up to the views, channel first; names as in the golden data, n_1 = 2048."""

    sa1_inds: Tensor
    """(n_1,) points picked, as indices into the cloud; for sa2 to sa4, into the points of the level before."""
    sa1_ball_idx: Tensor
    """(n_1, 64) points grouped about each, as indices likewise."""
    sa1_features: Tensor
    """(128, n_1)."""
    sa2_inds: Tensor
    sa2_ball_idx: Tensor
    sa2_features: Tensor
    sa3_inds: Tensor
    sa3_ball_idx: Tensor
    sa3_features: Tensor
    sa4_inds: Tensor
    sa4_ball_idx: Tensor
    sa4_features: Tensor
    fp1_features: Tensor
    """(256, 512)."""
    fp2_features: Tensor
    """(256, 1024), of the seeds."""
    fp2_xyz: Tensor
    """(1024, 3) seeds [m]."""
    fp2_inds: Tensor
    """(1024,) seeds as indices into the cloud."""
    objectness_score: Tensor
    """(2, 1024) logits: not graspable, graspable."""
    graspable_mask: Tensor
    """(1024,) bool."""
    view_score: Tensor
    """(1024, 300)."""
    grasp_top_view_inds: Tensor
    """(1024,) best view."""
    grasp_top_view_score: Tensor
    """(1024,) its score."""
    grasp_top_view_xyz: Tensor
    """(1024, 3) its direction, from the object outwards."""
    grasp_top_view_rot: Tensor
    """(1024, 3, 3) the frame that approaches against it, not turned in its plane."""
    rows: Tensor
    """(S,) seeds that the second stage ran on: all in a trace; else the graspable ones that are wanted."""

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return everything that was kept as arrays, by the names above."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value.cpu().numpy() for name, value in values.items() if value is not None}


def view_output(seeds: Seeds, approach: ApproachNet, *, trace: bool, wanted: Tensor | None) -> ViewOutput:
    """Choose a view for every seed.

    Args:
        seeds: From the backbone.
        approach: The network that judges views.
        trace: Let the second stage run on every seed.
        wanted: (N,) bool, the points of the cloud that a seed of the second stage may be; None = all.
    """
    out = approach(seeds.fp2_features)
    objectness, scores = out[:, :2], out[:, 2:]
    graspable = objectness.argmax(dim=1) == 1
    chosen = graspable if wanted is None else graspable & wanted[seeds.inds]
    best = scores.argmax(dim=1)
    directions = torch.from_numpy(view_directions()).to(out.device)[best]
    levels = {
        f"sa{i}_{name}": value
        for i, level in enumerate(seeds.levels, 1)
        for name, value in (("inds", level.inds), ("ball_idx", level.ball_idx), ("features", level.features.T))
    }
    return ViewOutput(
        **levels,
        fp1_features=seeds.fp1_features.T,
        fp2_features=seeds.fp2_features.T,
        fp2_xyz=seeds.xyz,
        fp2_inds=seeds.inds,
        objectness_score=objectness.T,
        graspable_mask=graspable,
        view_score=scores,
        grasp_top_view_inds=best,
        grasp_top_view_score=scores.gather(1, best[:, None])[:, 0],
        grasp_top_view_xyz=directions,
        grasp_top_view_rot=approach_rotations(-directions, torch.zeros(len(best), device=out.device)),
        rows=torch.arange(len(best), device=out.device) if trace else chosen.nonzero()[:, 0],
    )


class GraspNetwork(nn.Module):
    """A network that turns a cloud into rows of grasps."""

    what: ClassVar[str]
    """Its name in errors."""
    optional: ClassVar[tuple[str, ...]] = ()
    """Names that a file of weights may lack."""

    @classmethod
    def from_weights(cls, weights: Mapping[str, Tensor], device: str | torch.device = "cpu") -> Self:
        """Return the network with these weights, ready to run.

        Raises:
            ConfigError: They are another model's, whose names or shapes the message tells, or not finite.
        """
        network = cls()
        unused = load_strictly(network, weights, what=cls.what, optional=cls.optional)
        if unused:
            raise ConfigError(
                f"{cls.what}: these are weights of another model: {len(unused)} tensors have no place in it, "
                f"among them {unused[0]}"
            )
        broken = [name for name, value in network.state_dict().items() if not value.isfinite().all()]
        if broken:
            raise ConfigError(f"{cls.what}: {len(broken)} tensors hold values that are not finite, such as {broken[0]}")
        network.check_weights(weights)
        return ready(network, device)

    def check_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Raise ConfigError where weights that fit by name and shape cannot be this network's."""

    def tensor(self, cloud: NDArray[np.floating] | Tensor) -> Tensor:
        """Return a cloud (N, 3) [m] as the network takes it, on its device.

        Raises:
            InputError: It has another shape, no point, a point that is not finite, or one farther away than 100 m; or
                all of it lies about the origin.
        """
        device = next(self.parameters()).device
        if not isinstance(cloud, Tensor):
            cloud = torch.from_numpy(np.array(cloud, np.float32))
        points = cloud.to(device=device, dtype=torch.float32)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise InputError(
                f"{self.what}: the cloud must be (N, 3) with at least one point, got {tuple(points.shape)}"
            )
        largest = float(points.abs().max())
        if not np.isfinite(largest):
            raise InputError(f"{self.what}: the cloud holds coordinates that are not finite; leave such points out")
        if largest > MAX_COORDINATE_M:
            raise InputError(
                f"{self.what}: a coordinate of the cloud is {largest:g} m, at most {MAX_COORDINATE_M:g} m are allowed; "
                "are these millimetres? Give metres, in the camera's optical frame"
            )
        if float(points.square().sum(dim=1).max()) <= ORIGIN_SQUARED_M:
            raise InputError(
                f"{self.what}: the whole cloud lies within 3.16 cm of the origin, where points are left out; "
                "give metres, in the camera's optical frame, not about the object"
            )
        return points.contiguous()

    def mask(self, wanted: NDArray[np.bool_] | Tensor | None, cloud: Tensor) -> Tensor | None:
        """Return a mask of points (N,) as the network takes it.

        Raises:
            InputError: It is not boolean, or not as long as the cloud.
        """
        if wanted is None:
            return None
        mask = wanted if isinstance(wanted, Tensor) else torch.from_numpy(np.array(wanted))
        if mask.shape != cloud.shape[:1] or mask.dtype != torch.bool:
            raise InputError(f"{self.what}: wanted must be ({len(cloud)},) bool, got {tuple(mask.shape)} {mask.dtype}")
        return mask.to(cloud.device)
