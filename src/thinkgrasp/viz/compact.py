"""The three-dimensional view of a decision, small enough that a page can hold dozens of them."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Decision
from thinkgrasp.viz import view

MAX_CANDIDATES = 12
SHARES = (("target", 4500), ("objects", 5500), ("rest", 5000))
"""Most points of the target, of the other objects, and of everything else."""


def compact_scene(decision: Decision, gripper: Gripper) -> str:
    """Return the view's layers as JSON that may stand in a script element.

    Vertices are int16; a vertex in metres (camera frame) is `origin + scale * vertex`, which is exact to some 0.05 mm.

    Args:
        decision: Any status; what it lacks is left out.
        gripper: Geometry of the gripper to draw.
    """
    camera = decision.scene.frame.camera
    pivot = view.find_pivot(decision)
    fewer = replace(decision, alternatives=decision.alternatives[:MAX_CANDIDATES])
    solids = [layer for layer in view.make_layers(fewer, gripper, pivot) if layer.kind != "points"]
    layers = [layer for layer in (*_cloud(decision), *solids) if len(layer.positions)]
    scene = {
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "pivot": pivot.round(5).tolist(),
        "up": view.way_up(decision.scene).round(6).tolist(),
        "closing": None if decision.grasp is None else decision.grasp.rotation[:, 0].round(6).tolist(),
        "layers": [_pack(layer) for layer in layers],
    }
    return json.dumps(scene, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _cloud(decision: Decision) -> list[view.Layer]:
    points, frame = decision.scene.points, decision.scene.frame
    valid = np.isfinite(points[..., 2])
    target = np.zeros_like(valid) if decision.target is None else decision.target.mask & valid
    objects = view.object_mask(decision) & valid & ~target
    masks = {"target": target, "objects": objects, "rest": valid & ~target & ~objects}
    layers: list[view.Layer] = []
    for name, limit in SHARES:
        kept, step = view.thin(masks[name], limit)
        spacing = max(1.4 * step, 1.05 * float(np.ceil(step))) / frame.camera.fx
        is_target = name == "target"
        layers.append(
            view.Layer(
                "target" if is_target else "cloud",
                "points",
                points[kept],
                frame.color[kept],
                spacing,
                tintable=is_target,
            )
        )
    return layers


def _pack(layer: view.Layer) -> dict[str, object]:
    low, high = layer.positions.min(axis=0), layer.positions.max(axis=0)
    origin = (low.astype(np.float64) + high) / 2
    scale = max(float((high - low).max()) / 2 / 32767, 1e-9)
    vertices = np.rint((layer.positions - origin) / scale).clip(-32767, 32767)
    return {
        "name": layer.name,
        "kind": layer.kind,
        "origin": origin.round(6).tolist(),
        "scale": scale,
        "positions": _base64(vertices, "<i2"),
        "colors": _base64(layer.colors, "u1"),
        "spacing": layer.spacing,
        "alpha": layer.alpha,
        "tintable": layer.tintable,
    }


def _base64(array: NDArray[np.generic], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array).astype(dtype).tobytes()).decode("ascii")
