"""No segmenter: the region is what the plan itself says, its box or the surroundings of its pixel."""

from __future__ import annotations

import numpy as np

from thinkgrasp.errors import ConfigError
from thinkgrasp.types import Degradation, Mask, Plan, Scene, Segment, Segmentation


class PlanBoxSegmenter:
    """Take everything in the plan's cropping box for the target: the paper's ablation in which the model crops.

    Pixels on the support surface are left out where the scene knows it.
    """

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return one segment, or none where the plan has no box or nothing is measured in it."""
        if plan.crop_xyxy is None:
            return _nothing("the plan has no cropping box")
        x0, y0, x1, y1 = plan.crop_xyxy
        mask = np.zeros(scene.frame.depth.shape, np.bool_)
        mask[y0:y1, x0:x1] = True
        return _segmentation(scene, plan, mask & _measured(scene), f"nothing is measured in the box {plan.crop_xyxy}")


class PlanPointSegmenter:
    """Take what surrounds the plan's pixel for the target: the ablation in which the model names a grasp point.

    Args:
        radius_m: Of the ball around the measured point [m].

    Raises:
        ConfigError: The radius is not positive.
    """

    def __init__(self, *, radius_m: float = 0.05) -> None:
        if not 0 < radius_m <= 1:
            raise ConfigError(f"plan_point segmenter: radius_m must lie in (0, 1] m, got {radius_m}")
        self.radius_m = radius_m

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return one segment, or none where the plan has no pixel or nothing is measured at it."""
        if plan.point_px is None:
            return _nothing("the plan names no pixel")
        v, u = np.nonzero(_measured(scene))
        reason = f"nothing is measured near the pixel {plan.point_px}"
        if not len(u):
            return _nothing(reason)
        nearest = int(np.argmin((u - plan.point_px[0]) ** 2 + (v - plan.point_px[1]) ** 2))
        center = scene.points[v[nearest], u[nearest]]
        near = np.linalg.norm(scene.points - center, axis=-1) <= self.radius_m  # NaN compares as False
        return _segmentation(scene, plan, near & _measured(scene), reason)


def _measured(scene: Scene) -> Mask:
    measured = np.isfinite(scene.points[..., 2])
    if scene.region is not None:
        return measured & scene.region
    return measured if scene.frame.workspace is None else measured & scene.frame.workspace


def _segmentation(scene: Scene, plan: Plan, mask: Mask, reason: str) -> Segmentation:
    if not mask.any():
        return _nothing(reason)
    v, u = np.nonzero(mask)
    box = (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1)
    h, w = mask.shape
    touches = box[0] == 0 or box[1] == 0 or box[2] == w or box[3] == h
    return Segmentation((Segment(plan.target, 1.0, mask, box, touches, plan.mark),))


def _nothing(reason: str) -> Segmentation:
    return Segmentation((), (Degradation("segment", reason, "no segment"),))
