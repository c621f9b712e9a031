"""Colours, words and gripper geometry that the overlay and the 3-D view share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Grasp, Status

RGB = tuple[int, int, int]
Float = NDArray[np.float64]

TARGET: RGB = (255, 184, 28)
GRIPPER: RGB = (72, 190, 255)
POINT: RGB = (236, 44, 120)
INK: RGB = (22, 24, 28)
PAPER: RGB = (246, 247, 248)
MUTED: RGB = (168, 174, 182)
STATUS: dict[Status, RGB] = {"grasp": (82, 200, 120), "no_target": (255, 184, 28), "no_grasp": (240, 98, 84)}
STATUS_TEXT: dict[Status, str] = {"grasp": "GRASP", "no_target": "NO TARGET", "no_grasp": "NO GRASP"}

BOX_FACES = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))
"""Corner indices of a box's faces, each in order around the face."""


def box_corners(box: Float) -> Float:
    """Return the corners (8, 3) of a box given as (min, max) (2, 3); bit i of the index is the upper end of axis i."""
    bits = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    return np.take_along_axis(box, bits, axis=0)


def to_camera(grasp: Grasp, points: Float) -> Float:
    """Map points (..., 3) from the grasp frame to the camera frame."""
    return points @ grasp.rotation.T + grasp.position


def plain_text(text: str) -> str:
    """Return text on one line, without control characters or halves of surrogate pairs."""
    printable = text.encode("utf-8", "replace").decode("utf-8")
    return " ".join("".join(c if c.isprintable() else " " for c in printable).split())
