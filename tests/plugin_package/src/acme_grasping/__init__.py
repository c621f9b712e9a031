"""One small stage of every kind, written only against thinkgrasp's public interfaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage

from thinkgrasp.geometry import deproject
from thinkgrasp.types import (
    CameraIntrinsics,
    Frame,
    Grasps,
    Outcome,
    Plan,
    Proposal,
    Scene,
    Segment,
    Segmentation,
)


class DepthBands:
    """Whatever lies nearer than the median depth by a margin, one mark per connected patch."""

    def __init__(self, margin_m: float = 0.02, least_px: int = 40) -> None:
        if margin_m <= 0:
            raise ValueError(f"margin_m must be positive, got {margin_m}")
        self.margin_m = margin_m
        self.least_px = least_px

    def perceive(self, frame: Frame) -> Scene:
        points = deproject(frame.depth, frame.camera)
        valid = np.isfinite(points[..., 2])
        near = valid & (frame.depth < np.median(frame.depth[valid]) - self.margin_m)
        labels, n = ndimage.label(near)
        proposals = []
        for i in range(1, n + 1):
            mask = labels == i
            if mask.sum() >= self.least_px:
                proposals.append(self._proposal(len(proposals) + 1, mask, points))
        return Scene(frame, points, region=near, proposals=tuple(proposals))

    @staticmethod
    def _proposal(mark: int, mask: np.ndarray, points: np.ndarray) -> Proposal:
        seen = points[mask].astype(np.float64)
        low, high = seen.min(axis=0), seen.max(axis=0)
        order = np.argsort(low - high, kind="stable")
        axes = np.eye(3)[:, order]
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = axes, (low + high) / 2
        sides = np.maximum(high - low, 1e-3)[order]
        v, u = np.nonzero(mask)
        box = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
        border = box[0] == 0 or box[1] == 0 or box[2] == mask.shape[1] or box[3] == mask.shape[0]
        return Proposal(
            mark, mask, box, tuple(map(float, sides)), T, (0.0, float(sides[0])), (("grey", 1.0),), (), border, 0.5
        )


class NearestFirst:
    """Takes what is nearest to the camera, whatever is said."""

    def __init__(self, grid: int = 3) -> None:
        self.grid = grid

    def plan(self, scene, instruction, memory) -> Plan:
        cell = (self.grid**2 + 1) // 2
        if not scene.proposals:
            return Plan("", "nothing stands out", grid=self.grid, cell=cell, found=False)
        p = min(scene.proposals, key=lambda p: p.center_m[2])
        return Plan(f"thing {p.mark}", "it is nearest to the camera", mark=p.mark, grid=self.grid, cell=cell)


class MarkSegmenter:
    """The mask of the planned mark."""

    def segment(self, scene, plan) -> Segmentation:
        return Segmentation(
            tuple(
                Segment(plan.target, 1.0, p.mask, p.box_xyxy, p.touches_border, p.mark)
                for p in scene.proposals
                if p.mark == plan.mark
            )
        )


class StraightDown:
    """Grasps along the optical axis, closing at equally spaced angles."""

    def __init__(self, count: int = 12) -> None:
        self.count = count

    def generate(self, scene, crop, gripper, rng) -> Grasps:
        points = scene.points[crop & np.isfinite(scene.points[..., 2])]
        if not len(points):
            return Grasps.empty()
        angles = np.arange(self.count) * np.pi / self.count
        rotations = np.zeros((self.count, 3, 3), np.float32)
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angles)
        rotations[:, 1, 0], rotations[:, 0, 1] = np.sin(angles), -np.sin(angles)
        rotations[:, 2, 2] = 1
        return Grasps(
            rotations,
            points[rng.integers(0, len(points), self.count)],
            np.full(self.count, gripper.max_width_m, np.float32),
            np.linspace(0.1, 1, self.count, dtype=np.float32),
        )


class Reach:
    """Keeps grasps within a distance of the camera."""

    def __init__(self, most_m: float = 2.0) -> None:
        self.most_m = most_m

    def keep(self, scene, target, grasps, gripper) -> np.ndarray:
        return np.linalg.norm(grasps.positions, axis=1) <= self.most_m


class StillCamera:
    """A block on a table, seen from above; the same every time."""

    def __init__(self, height_m: float = 0.8) -> None:
        self.height_m = height_m

    def read(self) -> Frame:
        depth = np.full((48, 64), self.height_m, np.float32)
        depth[16:32, 20:44] -= 0.1
        color = np.full((48, 64, 3), 128, np.uint8)
        return Frame(color, depth, CameraIntrinsics(64, 48, 100.0, 100.0, 31.5, 23.5))


class DryRun:
    """Moves nothing and reports success."""

    def execute(self, grasp, frame) -> Outcome:
        return Outcome(True, "held")


class LineRecorder:
    """Appends one line per step to a file."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def record(self, decision, outcome) -> None:
        with self.path.open("a") as file:
            file.write(f"{decision.status} {outcome}\n")
