"""From a contact line to a pose of the gripper: the approach, the opening, and how deep the fingers may go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.generators.lines import ContactLines
from thinkgrasp.generators.surface import Float, Upright
from thinkgrasp.gripper import Gripper

_CHUNK = 512


@dataclass(frozen=True)
class PlacementSettings:
    """Lengths and angles of the placement."""

    tilts_rad: tuple[float, ...]
    """Turns about the closing direction, away from straight down."""
    max_tilt_rad: float
    """Largest angle between the approach and straight down."""
    max_towards_camera_rad: float
    """How far the approach may lean back towards the camera, where the surface is not seen."""
    clearance_m: float
    """Room wanted between each open finger and the contact."""
    min_clearance_m: float
    """Room that is always kept."""
    body_margin_m: float
    """Distance that the gripper's bodies keep from points."""
    tip_height_m: float
    """Lowest height of any body above the support."""
    min_engagement_m: float
    """The contact lies at least this far behind the fingertips."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses that fit, with the line each came from."""

    line: NDArray[np.intp]
    rotations: Float
    positions: Float
    widths: Float
    engagement: Float
    """(N,) how far the tips reach past the contact line [m]."""
    tilt: Float
    """(N,) angle between the approach and straight down [rad]."""


def place(
    lines: ContactLines, gripper: Gripper, upright: Upright, obstacles: Float, settings: PlacementSettings
) -> Placed:
    """Turn the gripper about each contact line and push it as deep as obstacles, palm and support allow.

    Args:
        lines: Contact lines of one object.
        gripper: Its bodies must keep `body_margin_m` from all obstacles, at the grasp and on the way there.
        upright: Up and away directions, and the support.
        obstacles: Points (M, 3) [m] of the object, seen and inferred, and of its surroundings.
        settings: Lengths and angles.
    """
    line, rotation, tilt = _orientations(lines, upright, settings)
    middle, distance = lines.middle[line], lines.distance[line]
    widest = np.nextafter(np.float32(gripper.max_width_m), np.float32(0))  # rounding must not open it too far
    narrow = np.minimum(distance + 2 * settings.clearance_m, widest)
    narrow = np.maximum(narrow, gripper.min_width_m)
    fits = (narrow >= distance + 2 * settings.min_clearance_m) & (narrow >= gripper.min_width_m)
    line, rotation, tilt, middle, narrow = line[fits], rotation[fits], tilt[fits], middle[fits], narrow[fits]

    width = narrow.copy()
    reach = reach_past(rotation, middle, width, gripper, upright, obstacles, settings)
    tight = np.flatnonzero(reach < settings.min_engagement_m)
    if len(tight):
        wide = np.minimum(narrow[tight] + 0.016, widest)
        wider = reach_past(rotation[tight], middle[tight], wide, gripper, upright, obstacles, settings)
        width[tight], reach[tight] = wide, wider
    wanted = 0.5 * gripper.pad_length_m
    engagement = np.minimum(reach, wanted)
    good = reach >= settings.min_engagement_m
    positions = middle + engagement[:, None] * rotation[:, :, 2]
    return Placed(line[good], rotation[good], positions[good], width[good], engagement[good], tilt[good])


def _orientations(
    lines: ContactLines, upright: Upright, settings: PlacementSettings
) -> tuple[NDArray[np.intp], Float, Float]:
    """Line index (K,), rotation (K, 3, 3) and tilt (K,) of every allowed approach."""
    down = -upright.up
    base = down - (lines.closing @ down)[:, None] * lines.closing
    base = base / np.linalg.norm(base, axis=1, keepdims=True)
    other = np.cross(lines.closing, base)
    turn = np.asarray(settings.tilts_rad, np.float32)
    approach = np.cos(turn)[None, :, None] * base[:, None] + np.sin(turn)[None, :, None] * other[:, None]
    tilt = np.arccos(np.clip(approach @ down, -1, 1))
    allowed = (tilt <= settings.max_tilt_rad + 1e-6) & (
        approach @ upright.away >= -np.sin(settings.max_towards_camera_rad) - 1e-6
    )
    line, k = np.nonzero(allowed)
    z = approach[line, k]
    x = lines.closing[line]
    rotation = np.stack([x, np.cross(z, x), z], axis=-1).astype(np.float32)
    return line, rotation, tilt[line, k].astype(np.float32)


def reach_past(
    rotation: Float,
    middle: Float,
    width: Float,
    gripper: Gripper,
    upright: Upright,
    obstacles: Float,
    settings: PlacementSettings,
) -> Float:
    """Return how far (K,) [m] the fingertips may go past `middle` (K, 3) along the approach; may be negative."""
    margin = np.float32(settings.body_margin_m)
    half = width / 2
    breadth, palm = gripper.finger_breadth_m / 2, gripper.palm_size_m
    reach = np.full(len(middle), np.inf, np.float32)
    for start in range(0, len(middle), _CHUNK):
        rows = slice(start, start + _CHUNK)
        R, m = rotation[rows], middle[rows]
        x, y, z = (obstacles @ R[:, :, i].T - np.einsum("ki,ki->k", R[:, :, i], m) for i in range(3))
        x, y = np.abs(x), np.abs(y)
        h = half[rows]
        in_finger = (x > h - margin) & (x < h + gripper.finger_thickness_m + margin) & (y < breadth + margin)
        in_palm = (x < palm[0] / 2 + margin) & (y < palm[1] / 2 + margin)
        tip = np.where(in_finger, z, np.inf).min(axis=0, initial=np.inf)
        back = np.where(in_palm, z, np.inf).min(axis=0, initial=np.inf) + np.float32(gripper.finger_length_m)
        reach[rows] = np.minimum(tip, back) - margin
    if not np.isfinite(upright.offset_m):
        return reach
    slope = np.abs(rotation.transpose(0, 2, 1) @ upright.up)
    fall = -(rotation[:, :, 2] @ upright.up)
    height = upright.height(middle)
    tips = slope[:, 0] * (half + gripper.finger_thickness_m) + slope[:, 1] * breadth
    wrist = slope[:, 0] * palm[0] / 2 + slope[:, 1] * palm[1] / 2 - fall * gripper.finger_length_m
    room = height - np.maximum(tips, wrist) - np.float32(settings.tip_height_m)
    steep = fall > 0.05
    limit = np.where(steep, room / np.where(steep, fall, 1), np.where(room >= 0, np.inf, -np.inf))
    return np.minimum(reach, limit.astype(np.float32))
