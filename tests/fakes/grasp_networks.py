"""Weights for the grasp networks: those of the golden data, and random ones."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import nn

from thinkgrasp.networks.fgc_graspnet import FGCGraspNet
from thinkgrasp.networks.graspnet import GraspNet

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "grasp_networks"
NETWORKS = {"graspnet": GraspNet, "fgc": FGCGraspNet}


@lru_cache(maxsize=4)
def golden(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / f"golden_{name}.npz") as file:
        return {key: file[key] for key in file.files}


def weights_of(data: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {key[2:]: torch.from_numpy(value) for key, value in data.items() if key.startswith("w/")}


def random_weights(name: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """A network that finds every seed graspable, and everything else at random."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = NETWORKS[name]()
        for module in network.modules():
            if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
                module.running_mean.normal_(0, 0.1)
                module.running_var.uniform_(0.5, 1.5)
    prefix = "view_estimator." if name == "graspnet" else ""
    weights = {key: value.clone() for key, value in network.state_dict().items()}
    weights[f"{prefix}vpmodule.conv3.weight"][:2] = 0
    weights[f"{prefix}vpmodule.conv3.bias"][:2] = torch.tensor([0.0, 1.0])
    if name == "graspnet":
        weights["grasp_generator.tolerance.conv3.bias"] += 0.05
        weights["grasp_generator.operation.conv3.bias"] += 0.05
    else:
        weights["operation.conv3.bias"] += 0.05
    return weights


def save(path: Path, weights: dict[str, torch.Tensor]) -> Path:
    """Write weights as the official trainers do."""
    torch.save({"epoch": 18, "optimizer_state_dict": {}, "loss": 0.1, "model_state_dict": weights}, path)
    return path


def table_cloud(n: int, seed: int = 0) -> np.ndarray:
    """A ball and a box on a table, (n, 3) float32 [m] before a camera, in random order."""
    rng = np.random.default_rng(seed)
    table = np.column_stack([rng.uniform(-0.25, 0.25, (n, 2)), np.full(n, 0.6)])
    ball = rng.normal(size=(n, 3))
    ball = 0.04 * ball / np.linalg.norm(ball, axis=1, keepdims=True) * [1, 1, -1] + [0.05, 0.0, 0.56]
    box = np.column_stack([rng.uniform([-0.13, 0.02], [-0.07, 0.08], (n, 2)), np.full(n, 0.55)])
    kind = rng.choice(3, n, p=[0.6, 0.25, 0.15])
    cloud = np.choose(kind[:, None], [table, ball, box])
    return (cloud + rng.normal(0, 0.0005, (n, 3))).astype(np.float32)
