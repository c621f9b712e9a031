"""ThinkGrasp: a sentence and an RGB-D frame in, a 6-DoF two-finger grasp out.

    from thinkgrasp import load_frame, make_pipeline
    decision = make_pipeline("offline").decide(load_frame("color.png", "depth.png", "camera.json"), "the mug")

Names are imported on first use, so that `import thinkgrasp` stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOME = {
    "CameraIntrinsics": "types",
    "Decision": "types",
    "Frame": "types",
    "Grasp": "types",
    "Grasps": "types",
    "Gripper": "gripper",
    "InputError": "errors",
    "Memory": "memory",
    "Pipeline": "pipeline",
    "Plan": "types",
    "Proposal": "types",
    "Scene": "types",
    "ThinkGraspError": "errors",
    "fuse": "fusion",
    "load_frame": "cameras.files",
    "make_pipeline": "config",
}

__all__ = [
    "CameraIntrinsics",
    "Decision",
    "Frame",
    "Grasp",
    "Grasps",
    "Gripper",
    "InputError",
    "Memory",
    "Pipeline",
    "Plan",
    "Proposal",
    "Scene",
    "ThinkGraspError",
    "__version__",
    "fuse",
    "load_frame",
    "make_pipeline",
]

if TYPE_CHECKING:
    from thinkgrasp.cameras.files import load_frame
    from thinkgrasp.config import make_pipeline
    from thinkgrasp.errors import InputError, ThinkGraspError
    from thinkgrasp.fusion import fuse
    from thinkgrasp.gripper import Gripper
    from thinkgrasp.memory import Memory
    from thinkgrasp.pipeline import Pipeline
    from thinkgrasp.types import CameraIntrinsics, Decision, Frame, Grasp, Grasps, Plan, Proposal, Scene


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'thinkgrasp' has no attribute {name!r}")
    return getattr(import_module(f"thinkgrasp.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
