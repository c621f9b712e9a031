"""Rendered tables with known things on them, seen by geometric perception, and how well the two agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.sim.solids import Box, Paint
from thinkgrasp.types import CameraIntrinsics, Frame, Mask, Proposal, Scene

RED, BLUE, GREEN = Paint((186, 34, 36)), Paint((40, 90, 190)), Paint((60, 150, 80))
YELLOW, PURPLE, ORANGE = Paint((230, 200, 50)), Paint((124, 60, 160)), Paint((228, 120, 30))
WHITE, BLACK = Paint((230, 230, 226)), Paint((36, 36, 40))

DESK = t.TableObject("desk", (Box((1.2, 0.6, 0.04), Paint((110, 90, 70)), t.pose(0.5, 1.1, -0.15)),), np.eye(4))
CHAIR = t.TableObject("chair", (Box((0.4, 0.4, 0.4), Paint((40, 110, 120)), t.pose(-0.8, 0.6, -0.4)),), np.eye(4))


def pinhole(width: int, height: int) -> CameraIntrinsics:
    """Return a camera with 56 degrees across, whatever the size."""
    return CameraIntrinsics(width, height, 0.95 * width, 0.95 * width, (width - 1) / 2, (height - 1) / 2)


def view(
    *objects: t.TableObject,
    eye: tuple[float, float, float] = (0.0, -0.5, 0.5),
    target: tuple[float, float, float] = (0.0, 0.0, 0.03),
    size: tuple[int, int] = (640, 480),
    dropout: float = 0.0,
    noise: bool = True,
    table_m: tuple[float, float] = (1.2, 0.8),
    background: tuple[t.TableObject, ...] = (),
) -> t.Rendering:
    """Render things on a table."""
    layout = t.TabletopScene(objects, table_size_m=table_m, background=background)
    return t.render(layout, pinhole(*size), t.look_at(eye, target), dropout=dropout, noise=noise)


def without_pose(frame: Frame) -> Frame:
    """Return the frame as a camera delivers it whose pose nobody knows."""
    return replace(frame, T_world_camera=None)


def perceive(rendering: t.Rendering) -> Scene:
    """Perceive a rendering without its camera pose."""
    return GeometricPerception().perceive(without_pose(rendering.frame))


def overlap(a: Mask, b: Mask) -> float:
    """Return the intersection of two masks over their union."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def matches(scene: Scene, rendering: t.Rendering) -> list[tuple[Proposal, float]]:
    """Return the best proposal of each object with its IoU.

    Raises:
        AssertionError: There is no proposal at all.
    """
    assert scene.proposals
    pairs = []
    for i in range(len(rendering.visible_fraction)):
        scored = [(overlap(p.mask, rendering.mask(i)), -p.mark, p) for p in scene.proposals]
        iou, _, proposal = max(scored, key=lambda s: s[:2])
        pairs.append((proposal, iou))
    return pairs


def lying(x: float, y: float, radius: float, yaw: float = 0.0) -> NDArray[np.float64]:
    """Return the pose of an upright solid of revolution laid on its side, its z axis along x before the turn."""
    down = np.eye(4)
    down[:3, :3] = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    down[:3, 3] = [0.0, 0.0, radius]
    return t.pose(x, y, 0.0, yaw) @ down
