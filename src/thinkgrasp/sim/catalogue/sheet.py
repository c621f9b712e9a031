"""One picture of all objects, drawn by the simulator's own renderer."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from thinkgrasp.geometry import make_transform
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.render import render
from thinkgrasp.sim.views import CameraView, look_at
from thinkgrasp.sim.world import World
from thinkgrasp.types import CameraIntrinsics

TILE_PX, CAPTION_PX, COLUMNS = 112, 14, 15
_PAPER = (250, 250, 250)
_PLACE = (0.5, 0.0)
_DIRECTIONS = {"front": (-0.75, -0.95, 0.85), "back": (0.75, 0.95, 0.85)}


def picture(
    obj: SimObject, side_px: int = TILE_PX, *, view: str = "front"
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Render one object that stands on the table.

    Args:
        obj: What to show; it fills the picture.
        side_px: Width and height.
        view: "front" or "back".

    Returns:
        (side, side, 3) RGB and (side, side) whether the object is seen there.
    """
    low, high = obj.bounds_m
    on_table = np.array([*_PLACE, -low[2]])
    world = World([obj], robot=False)
    world.place(0, make_transform(np.eye(3), on_table))
    mujoco.mj_forward(world.model, world.data)  # pyright: ignore[reportAttributeAccessIssue]
    radius = float(np.linalg.norm(high - low)) / 2
    target = (low + high) / 2 + on_table
    direction = np.array(_DIRECTIONS[view])
    eye = target + direction / np.linalg.norm(direction) * 4 * radius
    middle = (side_px - 1) / 2
    intrinsics = CameraIntrinsics(side_px, side_px, 1.9 * side_px, 1.9 * side_px, middle, middle)
    pose = look_at((eye[0], eye[1], eye[2]), (target[0], target[1], target[2]))
    seen = render(world.model, world.data, CameraView(intrinsics, pose), world.visuals)
    mask = np.append(world.object_of_geom, -1)[seen.geoms] == 0
    return seen.color, mask


def contact_sheet(objects: Sequence[SimObject]) -> Image.Image:
    """Return the pictures of objects in rows, each with its name."""
    rows = -(-len(objects) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * TILE_PX, rows * (TILE_PX + CAPTION_PX)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for i, obj in enumerate(objects):
        x, y = i % COLUMNS * TILE_PX, i // COLUMNS * (TILE_PX + CAPTION_PX)
        color, mask = picture(obj)
        sheet.paste(Image.fromarray(np.where(mask[..., None], color, np.array(_PAPER, np.uint8))), (x, y))
        draw.text((x + TILE_PX // 2, y + TILE_PX), obj.name, fill=(40, 40, 40), anchor="ma", font_size=10)
    return sheet
