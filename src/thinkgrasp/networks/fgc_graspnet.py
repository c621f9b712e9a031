"""FGC-GraspNet, for inference: cloud in, grasps and every intermediate out.

References:
    Lu et al., Hybrid Physical Metric For 6-DoF Grasp Pose Detection, ICRA 2022. Checked against the official modules
    (FGC-GraspNet, commit dedc17c) by golden data; the code is our own. The official repository states no licence, and
    its code derives from graspnet-baseline, whose weights are for non-commercial research only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thinkgrasp.errors import ConfigError
from thinkgrasp.networks.grasp_views import (
    CYLINDER_LOW_M,
    CYLINDER_RADIUS_M,
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
from thinkgrasp.networks.pointnet2 import Backbone, GroupMLP, Level, SharedMLP, folded

CYLINDER_HIGH_M = 0.02
CYLINDER_SAMPLES = 32
_SEEDS_PER_BLOCK = 128


@dataclass(frozen=True, eq=False)
class FGCOutput(ViewOutput):
    """Every intermediate of the network, of S seeds in the second stage; names as in the golden data."""

    cylinder_idx: Tensor
    """(1, S, 32) points of the first level within each seed's cylinder."""
    grouped: Tensor | None
    """(131, S, 32) their offsets in the seed's frame [m] and their features; kept in a trace, as the next two."""
    att_in: Tensor | None
    """(S, 256, 32) before the attention."""
    att_out: Tensor | None
    """(S, 256, 32) after it."""
    vp_features: Tensor
    """(256, S)."""
    grasp_score_pred: Tensor
    """(48, S) at 4 * angle + depth."""
    grasp_angle_cls_pred: Tensor
    """(12, S) logits."""
    grasp_width_pred: Tensor
    """(4, S) [m]."""
    grasp_depth_cls_pred: Tensor
    """(4, S) logits."""
    angle_class: Tensor
    """(S,) chosen angle, in steps of 15 degrees."""
    depth_class: Tensor
    """(S,) chosen depth, less 1, in centimetres."""
    grasps: Tensor
    """(n, 17) rows of the graspable seeds among S, in their order."""


class _Attention(nn.Module):
    """Self-attention among the slots of a group; queries and keys share their weights."""

    def __init__(self) -> None:
        super().__init__()
        self.q_conv = nn.Conv1d(256, 64, 1, bias=False)
        self.k_conv = nn.Conv1d(256, 64, 1, bias=False)
        self.k_conv.weight = self.q_conv.weight
        self.v_conv = nn.Conv1d(256, 256, 1)
        self.trans_conv = nn.Conv1d(256, 256, 1)
        self.after_norm = nn.BatchNorm1d(256)

    def forward(self, groups: Tensor) -> Tensor:
        """Return groups (G, slots, 256) after the attention.

        Weights a_ij are normalised over j, and slot i receives the sum of a_ji v_j: the transpose of what is usual.
        """
        rows = groups.flatten(0, 1)
        query = (rows @ self.q_conv.weight[..., 0].T).unflatten(0, groups.shape[:2])
        weights = torch.bmm(query, query.transpose(1, 2)).softmax(dim=2)
        value = nn.functional.linear(rows, self.v_conv.weight[..., 0], self.v_conv.bias).view_as(groups)
        change = torch.baddbmm(groups, weights.transpose(1, 2), value, alpha=-1)
        weight, bias = folded(self.trans_conv, self.after_norm)
        return torch.addmm(bias, change.flatten(0, 1), weight.T).relu_().view_as(groups).add_(groups)


class _Local(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.mlps = SharedMLP((3 + 128, 256))
        self.local_att = _Attention()


class FGCGraspNet(GraspNetwork):
    """FGC-GraspNet: views of seed points, then attention over the surroundings of each in the frame of its view."""

    what = "FGC-GraspNet"
    optional = ("local_att.local_att.k_conv.weight",)

    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone()
        self.vpmodule = ApproachNet()
        self.operation = Head((256, 128, 128, N_ANGLES * N_DEPTHS + N_ANGLES + 2 * N_DEPTHS))
        self.local_att = _Local()

    def check_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Raise ConfigError where queries and keys differ: in this network they are one tensor."""
        query, key = (weights.get(f"local_att.local_att.{name}_conv.weight") for name in "qk")
        if query is not None and key is not None and not torch.equal(query, key):
            raise ConfigError(
                f"{self.what}: these are weights of another model: the attention's q_conv and k_conv differ, and in "
                "this network they are one tensor"
            )

    @torch.inference_mode()
    def run(
        self,
        cloud: NDArray[np.floating] | Tensor,
        *,
        trace: bool = False,
        wanted: NDArray[np.bool_] | Tensor | None = None,
    ) -> FGCOutput:
        """Find grasps on a cloud.

        Args:
            cloud: (N, 3) [m], camera's optical frame, in random order; the official demo samples 20,000 points.
            trace: Run the second stage on every seed, not the graspable ones alone, and keep what is large.
            wanted: (N,) bool, points that grasps may start from; None = all.

        Raises:
            InputError: The cloud is empty, not finite, of another shape, or not in metres.
        """
        points = self.tensor(cloud)
        seeds = self.backbone(points)
        views = view_output(seeds, self.vpmodule, trace=trace, wanted=self.mask(wanted, points))
        rows, near = views.rows, seeds.levels[0]
        positions, rotations = views.fp2_xyz[rows], views.grasp_top_view_rot[rows]
        index = cylinder_query(
            near.xyz, positions, rotations, CYLINDER_RADIUS_M, CYLINDER_LOW_M, [CYLINDER_HIGH_M], CYLINDER_SAMPLES
        )
        offsets = torch.stack(turned(near.xyz[index[0]] - positions[:, None], rotations[:, None]), dim=2)
        before, after, features = self._attended(near, offsets, index[0], trace=trace)
        predicted = self.operation(features).T
        score, angle, width, depth = predicted.split([N_ANGLES * N_DEPTHS, N_ANGLES, N_DEPTHS, N_DEPTHS])
        angle_class, depth_class, best = decode(score, angle, width, depth)
        kept = views.graspable_mask[rows]
        grouped = torch.cat([offsets, near.features[index[0]]], dim=2).movedim(2, 0) if trace else None
        return FGCOutput(
            **{f.name: getattr(views, f.name) for f in fields(views)},
            cylinder_idx=index,
            grouped=grouped,
            att_in=before,
            att_out=after,
            vp_features=features.T,
            grasp_score_pred=score,
            grasp_angle_cls_pred=angle,
            grasp_width_pred=width,
            grasp_depth_cls_pred=depth,
            angle_class=angle_class,
            depth_class=depth_class,
            grasps=decoded_rows(
                best[kept, 0],
                best[kept, 1],
                depth_class[kept],
                angle_class[kept],
                views.grasp_top_view_xyz[rows[kept]],
                positions[kept],
            ),
        )

    def _attended(
        self, near: Level, offsets: Tensor, index: Tensor, *, trace: bool
    ) -> tuple[Tensor | None, Tensor | None, Tensor]:
        """Return groups (S, 256, 32) before and after the attention, in a trace, and pooled features (S, 256)."""
        mlp = GroupMLP(self.local_att.mlps, near.features)
        before, after = [], []
        pooled: list[Tensor] = [offsets.new_zeros(0, 256)]
        for some, at in zip(offsets.split(_SEEDS_PER_BLOCK), index.split(_SEEDS_PER_BLOCK), strict=True):
            groups = mlp(some.flatten(0, 1), at.flatten()).unflatten(0, at.shape)
            attended = self.local_att.local_att(groups)
            pooled.append(attended.amax(dim=1))
            if trace:
                before.append(groups.transpose(1, 2))
                after.append(attended.transpose(1, 2))
        return torch.cat(before) if trace else None, torch.cat(after) if trace else None, torch.cat(pooled)


def decode(score: Tensor, angle: Tensor, width: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Choose angle and depth for every seed, each by its logits.

    Args:
        score: (48, S) at 4 * angle + depth.
        angle: (12, S) logits.
        width: (4, S) [m].
        depth: (4, S) logits.

    Returns:
        Angle and depth classes (S,), and scores and raw widths (S, 2) [m].
    """
    angle_class, depth_class = angle.argmax(dim=0), depth.argmax(dim=0)
    best = score.gather(0, (N_DEPTHS * angle_class + depth_class)[None])[0]
    return angle_class, depth_class, torch.stack([best, width.gather(0, depth_class[None])[0]], dim=1)
