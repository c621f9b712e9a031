"""Grasps by the GraspNet-1Billion baseline, the paper's generator in simulation; brings no weights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thinkgrasp.generators.cloud_network import CloudNetworkGenerator, Network
from thinkgrasp.types import Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor


class GraspNetGenerator(CloudNetworkGenerator):
    """Propose grasps with GraspNet-1Billion; settings as in `CloudNetworkGenerator`.

    The network's score is log(mu_max / mu) of the friction mu that a grasp would need, weighted by its tolerance: any
    real number, above 1 for good grasps. Here it is 1 - exp(-score), 0 for negative ones: the share of the largest
    friction that is not needed.
    """

    name = "graspnet"
    known = "graspnet-realsense"

    @staticmethod
    def network(weights: dict[str, Tensor], device: torch.device) -> Network:
        """Return GraspNet with these weights, on a device."""
        from thinkgrasp.networks.graspnet import GraspNet

        return GraspNet.from_weights(weights, device)

    @staticmethod
    def quality(scores: Array) -> Array:
        """Return 1 - exp(-score), at least 0, for scores (n,)."""
        return -np.expm1(-np.maximum(scores, np.float32(0)))
