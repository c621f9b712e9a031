"""The main job on real frames: the right thing for what is asked, and nothing for what is not there."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from thinkgrasp import Frame, load_frame, make_pipeline
from thinkgrasp.memory import Memory
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.planners.offline import OfflinePlanner
from thinkgrasp.types import Decision, Scene

FRAMES = Path(__file__).parents[2] / "shared" / "real_scenes"
ANNOTATED = FRAMES / "annotations.json"
DATA = Path(__file__).parent / "data"

pytestmark = pytest.mark.skipif(not ANNOTATED.is_file(), reason=f"no real frames at {FRAMES}")


class OnePerceptionPerFrame:
    """A scene stage that looks at every frame once."""

    def __init__(self) -> None:
        self.seen: dict[int, Scene] = {}

    def perceive(self, frame: Frame) -> Scene:
        if id(frame) not in self.seen:
            self.seen[id(frame)] = GeometricPerception().perceive(frame)
        return self.seen[id(frame)]


@lru_cache(maxsize=1)
def perception() -> OnePerceptionPerFrame:
    return OnePerceptionPerFrame()


@lru_cache(maxsize=1)
def offline() -> Pipeline:
    pipeline = make_pipeline("offline")
    pipeline.scene = perception()
    return pipeline


@lru_cache(maxsize=128)
def decide(name: str, text: str) -> Decision:
    return offline().decide(frame(name), text)


@lru_cache(maxsize=8)
def frame(name: str) -> Frame:
    meta, mask = FRAMES / f"{name}-meta.mat", FRAMES / f"{name}-workspace_mask.png"
    camera = meta if meta.is_file() else FRAMES / "camera_params.json"
    return load_frame(
        FRAMES / f"{name}-color.png",
        FRAMES / f"{name}-depth.png",
        camera,
        workspace_mask=mask if mask.is_file() else None,
    )


def instructions(path: Path) -> list[tuple[str, str, list[list[float]]]]:
    scenes = json.loads(path.read_text())["scenes"]
    return [(n, e["instruction"], e["target_xyxy"]) for n, s in scenes.items() for e in s["instructions"]]


def iou(a: tuple[float, ...], b: list[float]) -> float:
    w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(w, 0) * max(h, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def grasps_it(decision: Decision, boxes: list[list[float]]) -> bool:
    """Whether the target's box is a named one and the TCP projects into that box."""
    if decision.target is None or decision.grasp is None:
        return False
    best = max(boxes, key=lambda b: iou(decision.target.box_xyxy, b))  # pyright: ignore[reportOptionalMemberAccess]
    u, v = decision.scene.frame.camera.project(decision.grasp.position)
    return iou(decision.target.box_xyxy, best) >= 0.5 and bool(best[0] <= u < best[2] and best[1] <= v < best[3])


def failures(path: Path) -> list[str]:
    return [f"{n}: {text}" for n, text, boxes in instructions(path) if not grasps_it(decide(n, text), boxes)]


def test_annotated_instructions_are_grasped() -> None:
    wrong = failures(ANNOTATED)
    assert len(wrong) <= 2, wrong


def test_rephrased_instructions_are_grasped() -> None:
    wrong = failures(DATA / "real_rephrased.json")
    assert len(wrong) <= 5, wrong


def test_what_is_not_there_is_seldom_taken_for_the_goal() -> None:
    planner, asked = OfflinePlanner(), instructions(DATA / "real_absent.json")
    plans = {(n, text): planner.plan(perception().perceive(frame(n)), text, Memory()) for n, text, _ in asked}
    taken = [f"{n}: {text} -> mark {p.mark}" for (n, text), p in plans.items() if p.found and p.role == "goal"]
    assert len(taken) <= 0.1 * len(asked), taken
    tidy = [p.found for (n, _), p in plans.items() if n == "000004"]
    assert np.mean(tidy) <= 0.15


def occupied_voxels(view: Frame, voxel_m: float = 0.003) -> np.ndarray:
    """Centres (K, 3) of the 3 mm voxels that hold a point; written anew here, not taken from what is tested."""
    camera = view.camera
    v, u = np.nonzero(view.depth > 0)
    z = view.depth[v, u].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    return (np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0) + 0.5) * voxel_m


def test_every_returned_grasp_is_clear_of_every_point() -> None:
    gripper = offline().gripper
    voxels = {name: occupied_voxels(frame(name)) for name in ("000000", "000004", "graspnet")}
    checked = 0
    for name, text, _ in instructions(ANNOTATED) + instructions(DATA / "real_rephrased.json"):
        decision = decide(name, text)
        if decision.grasp is None:
            continue
        support = decision.scene.support
        assert support is not None
        for grasp in (decision.grasp, *decision.alternatives):
            assert gripper.min_width_m <= grasp.width_m <= gripper.max_width_m
            near = voxels[name][np.linalg.norm(voxels[name] - grasp.position, axis=1) < 0.35]
            local = (near - grasp.position) @ grasp.rotation
            half, L = grasp.width_m / 2, gripper.finger_length_m
            px, py, pz = gripper.palm_size_m
            fingers = (
                (np.abs(local[:, 0]) >= half)
                & (np.abs(local[:, 0]) <= half + gripper.finger_thickness_m)
                & (np.abs(local[:, 1]) <= gripper.finger_breadth_m / 2)
            )
            palm = (np.abs(local[:, 0]) <= px / 2) & (np.abs(local[:, 1]) <= py / 2)
            for back in np.arange(0.0, 0.1001, 0.0025):
                depth = local[:, 2] + back
                assert not (fingers & (depth >= -L) & (depth <= 0)).any(), f"{name}: {text}"
                assert not (palm & (depth >= -L - pz) & (depth <= -L)).any(), f"{name}: {text}"
            corners = np.array([[sx * (half + gripper.finger_thickness_m), sy * gripper.finger_breadth_m / 2, z]
                                for sx in (-1, 1) for sy in (-1, 1) for z in (-L, 0.0)])  # fmt: skip
            assert (support.height(corners @ grasp.rotation.T + grasp.position) > 0).all()
            checked += 1
    assert checked >= 200
