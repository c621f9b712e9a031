"""Write a frame as the files that `thinkgrasp.cameras.files.load_frame` reads back."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from PIL import Image

from thinkgrasp.errors import InputError
from thinkgrasp.outputs import write_atomic
from thinkgrasp.types import Frame

DEPTH_SCALE = 0.001
"""Metres per unit of the 16-bit depth image."""


def save_frame(frame: Frame, folder: str | Path) -> tuple[Path, Path, Path]:
    """Write color.png, depth.png (16 bit, millimetres) and camera.json into a folder and return their paths.

    Depth is rounded to the millimetre.

    Raises:
        InputError: A depth is beyond 65.534 m, or the folder cannot be written.
    """
    folder = Path(folder)
    depth_mm = np.rint(np.nan_to_num(frame.depth.astype(np.float64), nan=0.0) / DEPTH_SCALE)
    if depth_mm.max(initial=0) >= 65535:
        raise InputError(f"depth up to {frame.depth.max():g} m does not fit into 16 bit of millimetres")
    camera: dict[str, object] = {
        name: getattr(frame.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
    }
    camera["depth_scale"] = DEPTH_SCALE
    if frame.T_world_camera is not None:
        camera["T_world_camera"] = frame.T_world_camera.tolist()
    paths = folder / "color.png", folder / "depth.png", folder / "camera.json"
    write_atomic(paths[0], _png(Image.fromarray(frame.color)))
    write_atomic(paths[1], _png(Image.fromarray(depth_mm.astype(np.uint16))))
    write_atomic(paths[2], (json.dumps(camera, indent=2) + "\n").encode())
    return paths


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()
