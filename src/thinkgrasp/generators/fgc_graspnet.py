"""Grasps by FGC-GraspNet, the paper's generator on the real robot; brings no weights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thinkgrasp.generators.cloud_network import CloudNetworkGenerator, Network
from thinkgrasp.types import Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor


class FGCGraspNetGenerator(CloudNetworkGenerator):
    """Propose grasps with FGC-GraspNet; settings as in `CloudNetworkGenerator`.

    The network learned a score in 0..1, a blend of force closure, flatness, distance to the centre of gravity, and
    room beside the object; what lies beyond is cut off.
    """

    name = "fgc_graspnet"
    known = "fgc-graspnet"

    @staticmethod
    def network(weights: dict[str, Tensor], device: torch.device) -> Network:
        """Return FGC-GraspNet with these weights, on a device."""
        from thinkgrasp.networks.fgc_graspnet import FGCGraspNet

        return FGCGraspNet.from_weights(weights, device)

    @staticmethod
    def quality(scores: Array) -> Array:
        """Return scores (n,) within 0..1."""
        return np.clip(scores, np.float32(0), np.float32(1))
