"""Grasps from the Volumetric Grasping Network and from geometry together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.generators.antipodal import AntipodalGenerator
from thinkgrasp.generators.vgn import VgnGenerator
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Mask, Scene

Ranking = Literal["own", "joint"]
ALIKE_M, ALIKE_DEG = 0.025, 40.0
"""Two grasps closer than this in place, approach and closing direction support each other."""


class VgnAntipodalGenerator:
    """Propose what either generator proposes.

    Args:
        weights: File of VGN's weights.
        ranking: "own" keeps each generator's scores, which are on one scale: 1.1 - mu, times factors. "joint" gives
            every grasp the mean of its own score and the best score of a grasp like it from the other generator, 0
            where there is none.
        vgn: Further settings of the VGN generator.
        antipodal: Settings of the antipodal generator.
        tip_height_m: Of both.
        device: Of the network; None = a GPU where there is one.

    Raises:
        ConfigError: A setting is out of range, or the weights are missing or another network's.
        MissingDependency: torch is not installed.
    """

    def __init__(
        self,
        *,
        weights: str | Path | None = None,
        ranking: Ranking = "own",
        vgn: Mapping[str, Any] | None = None,
        antipodal: Mapping[str, Any] | None = None,
        tip_height_m: float = 0.006,
        device: str | None = None,
    ) -> None:
        if ranking not in ("own", "joint"):
            raise ConfigError(f"vgn_antipodal generator: ranking must be 'own' or 'joint', got {ranking!r}")
        shared: dict[str, Any] = {"tip_height_m": tip_height_m}
        self.vgn = VgnGenerator(weights=weights, device=device, **(shared | dict(vgn or {})))
        self.antipodal = AntipodalGenerator(**(shared | dict(antipodal or {})))
        self.ranking = ranking

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        """Propose grasps on what lies under `crop` (H, W); camera frame, best first, empty where nothing fits."""
        learned, analytic = (g.generate(scene, crop, gripper, rng) for g in (self.vgn, self.antipodal))
        if self.ranking == "joint":
            learned, analytic = _supported(learned, analytic), _supported(analytic, learned)
        return Grasps.concatenate([learned, analytic])


def _supported(grasps: Grasps, others: Grasps) -> Grasps:
    """The grasps with the mean of their scores and those of the best `others` like them."""
    support = np.zeros(len(grasps), np.float32)
    if len(grasps) and len(others):
        support = np.where(_alike(grasps, others), others.scores, np.float32(0)).max(axis=1)
    return Grasps(grasps.rotations, grasps.positions, grasps.widths, (grasps.scores + support) / np.float32(2))


def _alike(a: Grasps, b: Grasps) -> NDArray[np.bool_]:
    """(N, M) True where grasps are about the same; a gripper turned by half a turn about its approach is the same."""
    cos = np.cos(np.deg2rad(ALIKE_DEG))
    near = np.linalg.norm(a.positions[:, None] - b.positions, axis=2) < ALIKE_M
    near &= a.rotations[:, :, 2] @ b.rotations[:, :, 2].T > cos
    return near & (np.abs(a.rotations[:, :, 0] @ b.rotations[:, :, 0].T) > cos)
