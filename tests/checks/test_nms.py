"""Suppression against the official one's results, and the half turn that it does not know."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thinkgrasp.checks.nms import SuppressionCheck, suppress
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.testing import sample_scene
from thinkgrasp.types import Grasps, Segment

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "grasp_networks"
needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"no golden data at {GOLDEN}")


def official(rows: np.ndarray) -> np.ndarray:
    rotations = rows[:, 4:13].reshape(-1, 3, 3)[:, :, [1, 2, 0]]
    return suppress(rotations, rows[:, 13:16], rows[:, 0], half_turn=False)


@needs_golden
@pytest.mark.parametrize("net", ["graspnet", "fgc"])
def test_golden(net):
    data = np.load(GOLDEN / f"golden_{net}.npz")
    assert official(data["grasps"]).tolist() == data["nms_kept_index"].tolist()
    free = np.flatnonzero(~data["collision_mask"])
    assert free[official(data["grasps"][free])].tolist() == data["collision_free_nms_kept_index"].tolist()


@needs_golden
def test_golden_edge_cases():
    data = np.load(GOLDEN / "golden_ops.npz")
    assert official(data["nms/grasps"]).tolist() == data["nms/kept"].tolist()


def turned(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


@pytest.mark.parametrize(
    ("rotation", "offset", "half_turn", "kept"),
    [
        (np.eye(3), 0.029, True, [1]),
        (np.eye(3), 0.03, True, [1, 0]),  # strictly nearer
        (turned("x", 29), 0, True, [1]),
        (turned("x", 31), 0, True, [1, 0]),
        (turned("z", 180), 0, True, [1]),
        (turned("z", 180), 0, False, [1, 0]),
        (turned("z", 152), 0, True, [1]),
        (turned("x", 180), 0, True, [1, 0]),  # from the other side: another grasp
    ],
)
def test_what_resembles(rotation, offset, half_turn, kept):
    rotations = np.stack([np.eye(3), rotation])
    positions = np.array([[0.0, 0, 0], [offset, 0, 0]])
    assert suppress(rotations, positions, np.array([0.1, 0.9]), half_turn=half_turn).tolist() == kept


def test_a_dropped_grasp_drops_none():
    rotations = np.repeat(np.eye(3)[None], 3, 0)
    positions = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.04, 0, 0]])
    assert suppress(rotations, positions, np.array([3.0, 2, 1])).tolist() == [0, 2]
    assert suppress(rotations[:0], positions[:0], np.zeros(0)).tolist() == []


def test_as_a_check():
    scene = sample_scene()
    p = scene.proposals[0]
    grasps = Grasps(
        np.repeat(np.eye(3, dtype=np.float32)[None], 3, 0),
        np.array([[0, 0, 0.5], [0.01, 0, 0.5], [0.1, 0, 0.5]], np.float32),
        np.full(3, 0.05, np.float32),
        np.array([0.2, 0.8, 0.1], np.float32),
    )
    target = Segment("thing", 1.0, p.mask, p.box_xyxy, p.touches_border, p.mark)
    kept = SuppressionCheck().keep(scene, target, grasps, GRIPPERS["robotiq_2f85"])
    assert kept.tolist() == [False, True, True]
    with pytest.raises(ConfigError, match="angle_deg"):
        SuppressionCheck(angle_deg=181)
