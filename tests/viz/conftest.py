"""Decisions made from rendered ground truth, so that the pictures are tested without the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from thinkgrasp.geometry import deproject, invert
from thinkgrasp.selection import preferred_point
from thinkgrasp.sim import tabletop
from thinkgrasp.types import (
    CameraIntrinsics,
    Decision,
    Degradation,
    FunnelStep,
    Grasp,
    Plan,
    Proposal,
    Scene,
    Segment,
    Status,
    SupportPlane,
)

BANANA = 3


def _grasps(point: np.ndarray, up: np.ndarray, n: int) -> list[Grasp]:
    """Grasps from above around a point, turned and tilted more and more."""
    grasps: list[Grasp] = []
    for i in range(n):
        approach = -up + 0.05 * i * np.array([1.0, 0, 0])
        approach /= np.linalg.norm(approach)
        closing = np.cross(approach, [np.sin(0.3 * i), np.cos(0.3 * i), 0.2])
        closing /= np.linalg.norm(closing)
        rotation = np.stack([closing, np.cross(approach, closing), approach], axis=1)
        grasps.append(Grasp(rotation, point, 0.05 + 0.003 * i, 1.0 - 0.1 * i))
    return grasps


@cache
def _rendering(camera: CameraIntrinsics) -> tabletop.Rendering:
    return tabletop.render(tabletop.demo_scene(0), camera, tabletop.demo_camera()[1])


@pytest.fixture
def make_decision() -> Callable[..., Decision]:
    """Return a maker of decisions about the banana of the demonstration scene."""

    def make(
        status: Status = "grasp",
        *,
        width: int = 160,
        height: int = 120,
        instruction: str = "I need a fruit",
        rationale: str = "The banana is the only fruit in view.",
        marks: bool = True,
        degraded: tuple[Degradation, ...] = (),
    ) -> Decision:
        focal = 590.0 * width / 640
        camera = CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        T_world_camera = tabletop.demo_camera()[1]
        r = _rendering(camera)
        points = deproject(r.frame.depth, camera)
        T_camera_world = invert(T_world_camera)
        up = T_camera_world[:3, 2]
        offset = -float(up @ T_camera_world[:3, 3])
        on_table = np.abs(points @ up + offset) < 0.005
        proposals = tuple(
            Proposal(
                i + 1,
                r.mask(i),
                _box(r.mask(i)),
                (0.1, 0.1, 0.1),
                np.eye(4),
                (0.0, 0.1),
                (("red", 1.0),),
                (),
                False,
                1.0,
            )
            for i in range(len(r.visible_fraction))
        )
        scene = Scene(
            r.frame, points, support=SupportPlane(up, offset, on_table, 0.001), proposals=proposals if marks else ()
        )
        timings = (("scene", 101.2), ("plan", 2.1), ("total", 103.3))
        plan = Plan("banana", rationale, mark=BANANA + 1, cell=5, found=status != "no_target", degraded=degraded)
        if status == "no_target":
            return Decision(status, instruction, scene, plan, degraded=degraded, timings_ms=timings)
        mask = r.mask(BANANA)
        target = Segment("banana", 0.93, mask, _box(mask), False, BANANA + 1)
        point = preferred_point(points, mask, target.box_xyxy, 3, 5)
        assert point is not None
        first, *others = _grasps(point, up, 6)
        funnel = (
            FunnelStep("candidates", 812, 812),
            FunnelStep("width", 812, 640),
            FunnelStep("collision", 640, 6 if status == "grasp" else 0),
        )
        decision = Decision(
            status, instruction, scene, plan, target, mask, point, None, (), funnel, degraded, timings_ms=timings
        )
        if status == "no_grasp":
            return decision
        return Decision(
            status, instruction, scene, plan, target, mask, point, first, tuple(others), funnel, degraded, timings
        )

    return make


def _box(mask: np.ndarray) -> tuple[int, int, int, int]:
    v, u = np.nonzero(mask)
    return int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
