"""The GraspNet-1Billion baseline, for inference: cloud in, grasps and every intermediate out.

References:
    Fang et al., GraspNet-1Billion: A Large-Scale Benchmark for General Object Grasping, CVPR 2020. Checked against the
    official modules (graspnet-baseline, commit 280c215) by golden data; the code is our own. The official weights are
    for non-commercial research only.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thinkgrasp.networks.grasp_views import (
    CYLINDER_LOW_M,
    CYLINDER_RADIUS_M,
    DEPTH_STEP_M,
    N_ANGLES,
    N_DEPTHS,
    ApproachNet,
    GraspNetwork,
    Head,
    ViewOutput,
    decoded_rows,
    view_output,
)
from thinkgrasp.networks.point_queries import cylinder_query, turned
from thinkgrasp.networks.pointnet2 import Backbone, GroupMLP, SharedMLP

CYLINDER_HIGHS_M = tuple((d + 1) * DEPTH_STEP_M for d in range(N_DEPTHS))
CYLINDER_SAMPLES = 64
MAX_TOLERANCE_M = 0.05
_SEEDS_PER_BLOCK = 64


@dataclass(frozen=True, eq=False)
class GraspNetOutput(ViewOutput):
    """Every intermediate of the network, of S seeds in the second stage; names as in the golden data."""

    cylinder_idx: Tensor
    """(4, S, 64) points of the cloud within the cylinder of each depth."""
    grouped: Tensor | None
    """(3, S, 4, 64) their offsets in the seed's frame [m]; kept in a trace."""
    vp_features: Tensor
    """(256, S, 4)."""
    grasp_score_pred: Tensor
    """(12, S, 4) by angle and depth."""
    grasp_angle_cls_pred: Tensor
    """(12, S, 4) logits."""
    grasp_width_pred: Tensor
    """(12, S, 4) [m]."""
    grasp_tolerance_pred: Tensor
    """(12, S, 4) [m]."""
    angle_class: Tensor
    """(S,) chosen angle, in steps of 15 degrees."""
    depth_class: Tensor
    """(S,) chosen depth, less 1, in centimetres."""
    grasps: Tensor
    """(n, 17) rows of the graspable seeds among S, in their order."""


class _Crop(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.mlps = SharedMLP((3, 64, 128, 256))


class _Views(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone()
        self.vpmodule = ApproachNet()


class _Grasps(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.crop = _Crop()
        self.operation = Head((256, 128, 128, 3 * N_ANGLES))
        self.tolerance = Head((256, 128, 128, N_ANGLES))


class GraspNet(GraspNetwork):
    """GraspNet-1Billion's two stages: views of seed points, then angle, depth, width and score for the best view."""

    what = "GraspNet-1Billion"

    def __init__(self) -> None:
        super().__init__()
        self.view_estimator = _Views()
        self.grasp_generator = _Grasps()

    @torch.inference_mode()
    def run(
        self,
        cloud: NDArray[np.floating] | Tensor,
        *,
        trace: bool = False,
        wanted: NDArray[np.bool_] | Tensor | None = None,
    ) -> GraspNetOutput:
        """Find grasps on a cloud.

        Args:
            cloud: (N, 3) [m], camera's optical frame, in random order; the official demo samples 20,000 points.
            trace: Run the second stage on every seed, not the graspable ones alone, and keep what is large.
            wanted: (N,) bool, points that grasps may start from; None = all.

        Raises:
            InputError: The cloud is empty, not finite, of another shape, or not in metres.
        """
        points = self.tensor(cloud)
        views = view_output(
            self.view_estimator.backbone(points),
            self.view_estimator.vpmodule,
            trace=trace,
            wanted=self.mask(wanted, points),
        )
        rows = views.rows
        seeds, rotations = views.fp2_xyz[rows], views.grasp_top_view_rot[rows]
        index = cylinder_query(
            points, seeds, rotations, CYLINDER_RADIUS_M, CYLINDER_LOW_M, CYLINDER_HIGHS_M, CYLINDER_SAMPLES
        )
        features = _pooled(GroupMLP(self.grasp_generator.crop.mlps, None), points, seeds, rotations, index)
        predicted = _by_column(features, [self.grasp_generator.operation, self.grasp_generator.tolerance])
        score, angle, width, tolerance = (predicted[..., k : k + N_ANGLES].movedim(2, 0) for k in (0, 12, 24, 36))
        angle_class, depth_class, best = decode(score, angle, width, tolerance)
        kept = views.graspable_mask[rows]
        return GraspNetOutput(
            **{f.name: getattr(views, f.name) for f in fields(views)},
            cylinder_idx=index,
            grouped=_grouped(points, seeds, rotations, index) if trace else None,
            vp_features=features.movedim(2, 0),
            grasp_score_pred=score,
            grasp_angle_cls_pred=angle,
            grasp_width_pred=width,
            grasp_tolerance_pred=tolerance,
            angle_class=angle_class,
            depth_class=depth_class,
            grasps=decoded_rows(
                best[kept, 0],
                best[kept, 1],
                depth_class[kept],
                angle_class[kept],
                views.grasp_top_view_xyz[rows[kept]],
                seeds[kept],
            ),
        )


def decode(score: Tensor, angle: Tensor, width: Tensor, tolerance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Choose angle and depth for every seed.

    The angle is chosen for each depth by its logits, the depth by the score at that angle before the tolerance weighs
    in; of equal scores the smaller depth wins.

    Args:
        score: (12, S, 4) by angle and depth.
        angle: Logits, likewise.
        width: [m], likewise.
        tolerance: [m], likewise.

    Returns:
        Angle and depth classes (S,), and weighted scores and raw widths (S, 2) [m].
    """
    angles = angle.argmax(dim=0, keepdim=True)
    by_depth = score.gather(0, angles)[0]
    depth = by_depth.argmax(dim=1, keepdim=True)
    chosen = angles[0].gather(1, depth)
    best, opening, slack = (v.gather(0, angles)[0].gather(1, depth)[:, 0] for v in (score, width, tolerance))
    return chosen[:, 0], depth[:, 0], torch.stack([best * slack / MAX_TOLERANCE_M, opening], dim=1)


def _pooled(mlp: GroupMLP, points: Tensor, seeds: Tensor, rotations: Tensor, index: Tensor) -> Tensor:
    """Return the largest features (S, 4, 256) of each seed's cylinders.

    The features of a point depend on the seed, not on the depth, and the cylinders are nested: every pair of seed and
    point is computed once, and every list of points is pooled once. So depths that hold the same points are equal to
    the last bit.
    """
    pooled: list[Tensor] = [seeds.new_zeros(0, N_DEPTHS, 256)]
    for some, seed, rotation in zip(
        index.split(_SEEDS_PER_BLOCK, 1), seeds.split(_SEEDS_PER_BLOCK), rotations.split(_SEEDS_PER_BLOCK), strict=True
    ):
        slots = some.transpose(0, 1)
        ordered, order = slots.flatten(1).sort(dim=1)
        first = torch.ones_like(ordered, dtype=torch.bool)
        first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
        pair = (torch.cumsum(first.flatten(), 0) - 1).view_as(ordered)
        row, point = first.nonzero()[:, 0], ordered[first]
        offsets = points.index_select(0, point) - seed.index_select(0, row)
        local = torch.stack(turned(offsets, rotation.index_select(0, row)), dim=1)
        new = torch.ones(slots.shape[:2], dtype=torch.bool, device=slots.device)
        new[:, 1:] = (slots[:, 1:] != slots[:, :-1]).any(dim=2)
        where = torch.empty_like(pair).scatter_(1, order, pair).view_as(slots)[new]
        largest = mlp.pooled(local, point, partial(_largest_of, where=where))
        pooled.append(largest[(torch.cumsum(new.flatten(), 0) - 1).view_as(new)])
    return torch.cat(pooled)


def _largest_of(rows: Tensor, where: Tensor) -> Tensor:
    return rows.index_select(0, where.flatten()).view(*where.shape, -1).amax(dim=1)


def _grouped(points: Tensor, seeds: Tensor, rotations: Tensor, index: Tensor) -> Tensor:
    local = turned(points[index] - seeds[:, None], rotations[:, None])
    return torch.stack(local).transpose(1, 2)


def _by_column(features: Tensor, heads: list[Head]) -> Tensor:
    """Apply heads to features (S, 4, C), once where consecutive depths are equal, so that their results are equal too.

    Returns:
        (S, 4, sum of the heads' channels).
    """
    new = torch.ones(features.shape[:2], dtype=torch.bool, device=features.device)
    new[:, 1:] = (features[:, 1:] != features[:, :-1]).any(dim=2)
    out = torch.cat([head(features[new]) for head in heads], dim=1)
    return out[(torch.cumsum(new.flatten(), 0) - 1).view_as(new)]
