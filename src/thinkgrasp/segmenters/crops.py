"""A closer look: the scene cut to a box, what was found there put back, and whether an image is worth looking into."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinkgrasp.segmenters.boxes import segment_of
from thinkgrasp.types import BoxXYXY, CameraIntrinsics, Frame, Scene, Segment

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def widened(box_xyxy: BoxXYXY, share: float, image_hw: tuple[int, int]) -> BoxXYXY:
    """Return a box that is wider by that share of its sides at each side, cut to the image."""
    x0, y0, x1, y1 = box_xyxy
    dx, dy = round(share * (x1 - x0)), round(share * (y1 - y0))
    return max(x0 - dx, 0), max(y0 - dy, 0), min(x1 + dx, image_hw[1]), min(y1 + dy, image_hw[0])


def cut_scene(scene: Scene, box_xyxy: BoxXYXY) -> Scene:
    """Return colours, depth and points of a box, without proposals.

    Its camera keeps the focal lengths; where the optical axis lies outside the box, the principal point is moved to
    the nearest pixel inside. `points` are the scene's own, in the camera frame as before.
    """
    x0, y0, x1, y1 = box_xyxy
    window = slice(y0, y1), slice(x0, x1)
    full, frame = scene.frame.camera, scene.frame
    cx, cy = float(np.clip(full.cx - x0, 0, x1 - x0 - 1)), float(np.clip(full.cy - y0, 0, y1 - y0 - 1))
    camera = CameraIntrinsics(x1 - x0, y1 - y0, full.fx, full.fy, cx, cy)
    workspace = None if frame.workspace is None else frame.workspace[window]
    cut = Frame(frame.color[window], frame.depth[window], camera, frame.T_world_camera, workspace)
    return Scene(cut, scene.points[window])


def put_back(segment: Segment, box_xyxy: BoxXYXY, image_hw: tuple[int, int]) -> Segment:
    """Return a segment that was found in `cut_scene` as one of the whole image."""
    x0, y0, x1, y1 = box_xyxy
    mask = np.zeros(image_hw, np.bool_)
    mask[y0:y1, x0:x1] = segment.mask
    return segment_of(mask, segment.label, segment.score)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an RGB image's grey levels 0..255.

    About 100 and more for sharp camera images, 20 to 30 when they are blurred by 1 px (sigma), 3 by 2 px.
    """
    return float(ndimage.laplace(image.astype(np.float32) @ _LUMA).var())
