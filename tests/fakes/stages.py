"""Small deterministic stages for tests: they see whatever is nearer than the table, and grasp it from above."""

from __future__ import annotations

import numpy as np

from thinkgrasp.geometry import deproject
from thinkgrasp.gripper import GRIPPERS, Gripper
from thinkgrasp.memory import Memory
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.types import (
    CameraIntrinsics,
    Frame,
    Grasps,
    Mask,
    Plan,
    Proposal,
    Scene,
    Segment,
    Segmentation,
)

TABLE_M = 0.80
THING_M = 0.70


def table_frame(
    *, width: int = 64, height: int = 48, things: bool = True, T_world_camera: np.ndarray | None = None
) -> Frame:
    """A camera that looks straight down at a table with a red block left and a blue block right."""
    color = np.full((height, width, 3), 180, np.uint8)
    depth = np.full((height, width), TABLE_M, np.float32)
    if things:
        rows = slice(height // 3, 2 * height // 3)
        for columns, paint in ((slice(8, 24), (200, 20, 20)), (slice(40, 56), (20, 20, 200))):
            color[rows, columns] = paint
            depth[rows, columns] = THING_M
    camera = CameraIntrinsics(width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2)
    return Frame(color, depth, camera, T_world_camera)


def box_of(mask: Mask) -> tuple[int, int, int, int]:
    v, u = np.nonzero(mask)
    return int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1


class FakeScene:
    """Left and right half of everything nearer than the table are marks 1 and 2."""

    def perceive(self, frame: Frame) -> Scene:
        near = (frame.depth > 0) & (frame.depth < TABLE_M - 0.01)
        left = np.arange(frame.camera.width) < frame.camera.width // 2
        points = deproject(frame.depth, frame.camera)
        proposals = []
        for half, color in ((left, "red"), (~left, "blue")):
            mask = near & half
            if mask.any():
                proposals.append(_proposal(len(proposals) + 1, mask, points, color))
        return Scene(frame, points, proposals=tuple(proposals))


def _proposal(mark: int, mask: Mask, points: np.ndarray, color: str) -> Proposal:
    T = np.eye(4)
    T[:3, 3] = points[mask].mean(axis=0)
    return Proposal(
        mark, mask, box_of(mask), (0.1, 0.1, 0.1), T, (0.0, 0.1), ((color, 1.0),), (("box-like", 1.0),), False, 0.9
    )


class FakePlanner:
    """Takes the first proposal whose colour is named in the instruction; without proposals the whole image."""

    def __init__(self, grid: int = 3, cell: int = 5) -> None:
        self.grid = grid
        self.cell = cell

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        for p in scene.proposals:
            if p.colors and p.colors[0][0] in instruction.lower():
                return Plan(p.colors[0][0], "its colour fits", mark=p.mark, grid=self.grid, cell=self.cell)
        return Plan("", "no colour of the instruction is in view", grid=self.grid, cell=self.cell, found=False)


class FakeSegmenter:
    """The planned mark's mask."""

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        if plan.mark is None:
            return Segmentation(())
        p = scene.proposal(plan.mark)
        return Segmentation((Segment(plan.target, 0.9, p.mask, p.box_xyxy, p.touches_border, p.mark),))


class FakeGenerator:
    """Top-down grasps at random masked points, with random scores."""

    def __init__(self, n: int = 20) -> None:
        self.n = n

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        points = scene.points[crop & np.isfinite(scene.points[..., 2])]
        if not len(points):
            return Grasps.empty()
        positions = points[rng.integers(0, len(points), self.n)]
        rotations = np.broadcast_to(np.eye(3, dtype=np.float32), (self.n, 3, 3)).copy()
        widths = np.full(self.n, gripper.max_width_m / 2, np.float32)
        return Grasps(rotations, positions, widths, rng.uniform(0, 1, self.n).astype(np.float32))


class FakeCheck:
    """Keeps grasps at or above a score."""

    def __init__(self, least: float = 0.3) -> None:
        self.least = least

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> np.ndarray:
        return grasps.scores >= self.least


def fake_pipeline(**changes: object) -> Pipeline:
    stages: dict[str, object] = {
        "scene": FakeScene(),
        "planner": FakePlanner(),
        "segmenter": FakeSegmenter(),
        "generator": FakeGenerator(),
        "checks": {"score": FakeCheck()},
        "gripper": GRIPPERS["robotiq_2f85"],
    }
    return Pipeline(**(stages | changes))  # type: ignore[arg-type]


def camera_dict(**changes: object) -> dict[str, object]:
    """The camera of `table_frame` as JSON values; a change to None removes the key."""
    data: dict[str, object] = {"width": 64, "height": 48, "fx": 100.0, "fy": 100.0, "cx": 31.5, "cy": 23.5}
    data |= changes
    return {k: v for k, v in data.items() if v is not None}
