"""Things as they must be, not only as they are seen: what floats in the view stands on the support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thinkgrasp.types import Proposal, Scene

MIN_GAP_M = 0.012
"""A lowest seen point below this is at the support already."""
MIN_ALIGNED = 0.8
"""Cosine between an axis of the thing and the support's normal from which on that axis is vertical."""
FLAT_RATIO = 0.35
"""A thing whose shortest side exceeds this share of its middle one is not flat."""


def stand_down(scene: Scene) -> Scene:
    """Lengthen every thing of which only the upper part is seen, and that rests on nothing else, to the support.

    From above a camera sees the lid of a can and takes it for a disc. Heights say how high the lid is.

    Args:
        scene: Proposals with heights; edges say what rests on what.

    Returns:
        The scene with the proposals' sides, flatness and length corrected; masks, boxes and marks are kept.
    """
    if scene.support is None:
        return scene
    carried = {e.a for e in scene.obstructions if e.relation == "rests_on"}
    up = scene.support.normal
    things = tuple(p if p.mark in carried else _down(p, up) for p in scene.proposals)
    return replace(scene, proposals=things)


def _down(thing: Proposal, up: np.ndarray) -> Proposal:
    low, high = thing.height_m
    aligned = np.abs(up @ thing.T_camera_object[:3, :3])
    axis = int(aligned.argmax())
    if low < MIN_GAP_M or aligned[axis] < MIN_ALIGNED or high <= thing.extents_m[axis] + MIN_GAP_M:
        return thing
    sides = np.array(thing.extents_m)
    sides[axis] = high
    order = np.argsort(-sides, kind="stable")
    longest, middle, shortest = (float(s) for s in sides[order])
    T = thing.T_camera_object.copy()
    T[:3, :3] = T[:3, order]
    if np.linalg.det(T[:3, :3]) < 0:
        T[:3, 2] *= -1
    degrees = dict(thing.shapes)
    degrees["flat"] = degrees.get("flat", 0.0) * float(np.clip((FLAT_RATIO - shortest / middle) / 0.1, 0, 1))
    if axis == int(order[0]):
        degrees["elongated"] = float(np.clip((longest / middle - 1.5) / 1.0, 0, 1))
    shapes = tuple(sorted(degrees.items(), key=lambda item: (-item[1], item[0])))
    return replace(thing, extents_m=(longest, middle, shortest), T_camera_object=T, height_m=(0.0, high), shapes=shapes)
