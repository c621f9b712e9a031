"""Every stage's contract, on one page.

A plug-in is any class (or factory) that returns an object with the method below. Register it in the entry-point group
named beside its Protocol; check it with `thinkgrasp.testing`. Keyword arguments of the constructor are its settings.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.gripper import Gripper
from thinkgrasp.memory import Memory
from thinkgrasp.types import Decision, Frame, Grasp, Grasps, Mask, Outcome, Plan, Scene, Segment, Segmentation


@runtime_checkable
class ScenePerception(Protocol):
    """Entry-point group `thinkgrasp.scene`."""

    def perceive(self, frame: Frame) -> Scene:
        """Find the support, the proposals (marks 1..n) and their obstruction graph; never raises on an empty scene."""
        ...


@runtime_checkable
class Planner(Protocol):
    """Entry-point group `thinkgrasp.planner`."""

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Choose what to take now. A scene without proposals (strict mode) must be planned from the image alone."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Entry-point group `thinkgrasp.segmenter`."""

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return all masks that answer to the plan, best first; empty when there are none."""
        ...


@runtime_checkable
class GraspGenerator(Protocol):
    """Entry-point group `thinkgrasp.generator`."""

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        """Propose grasps on the points under `crop` (H, W), in the camera frame, scores 0..1; same rng, same grasps."""
        ...


@runtime_checkable
class Check(Protocol):
    """Entry-point group `thinkgrasp.check`."""

    def keep(self, scene: Scene, target: Segment, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """Return (N,) True for the grasps that pass. `scene.cloud()` is all that was seen, not the crop."""
        ...


@runtime_checkable
class Camera(Protocol):
    """Entry-point group `thinkgrasp.camera`."""

    def read(self) -> Frame:
        """Return the next aligned frame."""
        ...


@runtime_checkable
class Robot(Protocol):
    """Entry-point group `thinkgrasp.robot`."""

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        """Carry out a grasp given in that frame's camera coordinates and report what became of it."""
        ...


@runtime_checkable
class Recorder(Protocol):
    """Entry-point group `thinkgrasp.recorder`."""

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Keep one step; durable when the call returns."""
        ...
