"""Hand-made scenes: things as labelled boxes on a table, seen at 45 degrees, without any image processing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thinkgrasp.types import CameraIntrinsics, Frame, Mask, Obstruction, Proposal, Scene, SupportPlane

WIDTH, HEIGHT = 640, 480
CAMERA = CameraIntrinsics(WIDTH, HEIGHT, 600.0, 600.0, 320.0, 240.0)
UP = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
FORWARD = np.array([0.0, -np.sqrt(0.5), np.sqrt(0.5)])
"""Away from the camera, along the table."""
ORIGIN = np.array([0.0, 0.0, 0.9])
"""The table point in the middle of the view."""


def thing(
    mark: int,
    at: tuple[float, float],
    size: tuple[float, float, float],
    colors: dict[str, float],
    shapes: dict[str, float],
    *,
    raised: float = 0.0,
    mask: Mask | None = None,
    confidence: float = 0.9,
) -> Proposal:
    """Make a proposal from where it stands (right, away) [m] on the table and its sides (across, deep, high) [m]."""
    right = np.array([1.0, 0.0, 0.0])
    center = ORIGIN + at[0] * right + at[1] * FORWARD + (raised + size[2] / 2) * UP
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    corners = center + (signs * np.array(size) / 2) @ np.stack([right, FORWARD, UP])
    pixels = CAMERA.project(corners)
    x0, y0 = np.clip(np.floor(pixels.min(axis=0)).astype(int), 0, [WIDTH - 2, HEIGHT - 2])
    x1, y1 = np.clip(np.ceil(pixels.max(axis=0)).astype(int), [x0 + 1, y0 + 1], [WIDTH, HEIGHT])
    if mask is None:
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        visible = (
            ((u - (x0 + x1 - 1) / 2) / ((x1 - x0) / 2)) ** 2 + ((v - (y0 + y1 - 1) / 2) / ((y1 - y0) / 2)) ** 2
        ) <= 1
    else:
        visible = mask
        v, u = np.nonzero(mask)
        x0, y0, x1, y1 = u.min(), v.min(), u.max() + 1, v.max() + 1
    T = np.eye(4)
    T[:3, 3] = center
    longest, middle, shortest = sorted(size, reverse=True)
    return Proposal(
        mark=mark,
        mask=visible,
        box_xyxy=(int(x0), int(y0), int(x1), int(y1)),
        extents_m=(longest, middle, shortest),
        T_camera_object=T,
        height_m=(raised, raised + size[2]),
        colors=tuple(sorted(colors.items(), key=lambda c: -c[1])),
        shapes=tuple(sorted(shapes.items(), key=lambda s: -s[1])),
        touches_border=False,
        confidence=confidence,
    )


def scene(things: Sequence[Proposal], edges: Sequence[Obstruction] = ()) -> Scene:
    """Put proposals on the table; the cloud is the table's plane."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = (ORIGIN @ UP) / (rays @ UP)
    points = (rays * depth[..., None]).astype(np.float32)
    frame = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), points[..., 2].copy(), CAMERA)
    support = SupportPlane(UP, -float(ORIGIN @ UP), np.ones((HEIGHT, WIDTH), bool), 0.001)
    return Scene(frame, points, support=support, proposals=tuple(things), obstructions=tuple(edges))


def household() -> Scene:
    """Return a tidy table with ten things that stand apart."""
    return scene(
        [
            thing(
                1,
                (-0.30, 0.15),
                (0.085, 0.085, 0.10),
                {"blue": 0.2, "black": 0.75},
                {"cylindrical": 0.8, "hollow": 0.8},
            ),
            thing(
                2, (-0.05, 0.00), (0.085, 0.085, 0.09), {"white": 0.8, "grey": 0.2}, {"cylindrical": 0.7, "hollow": 0.9}
            ),
            thing(3, (0.25, 0.15), (0.16, 0.06, 0.21), {"red": 0.6, "yellow": 0.2, "white": 0.2}, {"box-like": 0.9}),
            thing(4, (-0.15, -0.18), (0.16, 0.16, 0.06), {"green": 0.8, "blue": 0.2}, {"round": 0.9, "hollow": 0.9}),
            thing(
                5, (0.30, -0.10), (0.067, 0.067, 0.10), {"red": 0.4, "white": 0.4, "grey": 0.2}, {"cylindrical": 0.9}
            ),
            thing(
                6,
                (0.08, -0.20),
                (0.19, 0.04, 0.04),
                {"yellow": 0.9, "brown": 0.1},
                {"elongated": 0.9, "cylindrical": 0.3},
            ),
            thing(
                7,
                (0.05, 0.25),
                (0.095, 0.06, 0.19),
                {"yellow": 0.8, "blue": 0.1, "white": 0.1},
                {"cylindrical": 0.5, "box-like": 0.3},
            ),
            thing(8, (-0.15, 0.28), (0.18, 0.18, 0.06), {"orange": 0.6, "black": 0.4}, {"elongated": 0.2}),
            thing(9, (0.15, 0.02), (0.075, 0.075, 0.075), {"red": 0.9, "green": 0.1}, {"round": 0.95}),
            thing(
                10,
                (-0.38, -0.15),
                (0.14, 0.018, 0.018),
                {"black": 0.9, "grey": 0.1},
                {"elongated": 0.95, "cylindrical": 0.7},
            ),
        ]
    )
