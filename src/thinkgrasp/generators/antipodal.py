"""Antipodal grasps from one view, by geometry alone: no network, no training, no GPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thinkgrasp.errors import ConfigError
from thinkgrasp.generators.lines import ContactLines, pair_lines, rim_lines
from thinkgrasp.generators.placement import PlacementSettings, place
from thinkgrasp.generators.surface import Completed, Surface, Upright
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Mask, Scene

_MIN_PIXELS = 24
_LOWEST_TIP_M = 0.0035


class AntipodalGenerator:
    """Propose two-finger grasps between opposite surfaces, seen or inferred.

    Each object under the crop is completed on its own (see `surface`), contact lines are drawn through it and across
    its rims (`lines`), and the gripper is turned about each line and pushed in as far as it fits (`placement`).

    The score is s = 1.1 - mu of the contact pair times factors in (0, 1]: 0.95 per inferred contact (a rim: 0.9, and
    0.7 where no wall was seen below it), 1 down to 0.75 with the distance from the object's middle, 0.75 up to 1 with
    the share of the wanted finger depth, and 1 down to 0.85 with the tilt from straight down.

    Args:
        max_grasps: At most so many, best first.
        max_points: Sampled points per object.
        voxel_m: Smallest spacing of these points.
        n_seeds: Points tried as first contact, shared by the objects under the crop.
        n_lines: Contact lines kept, shared likewise.
        n_rim_points: Points probed for rims, shared likewise.
        max_friction: Pairs that need more friction than this are left out (pinches across a convex edge need 1.0).
        max_tilt_deg: Largest angle between the approach and straight down (or the view, without a support).
        max_towards_camera_deg: How far the approach may lean back towards the camera.
        clearance_m: Room between each open finger and the contact where the gripper opens that far.
        min_clearance_m: Room that is always kept; what needs more than the gripper's opening is left out.
        body_margin_m: Distance between the gripper's bodies and all points nearby.
        tip_height_m: Lowest height of fingers and palm above the support; for things less than 2 cm tall, down to
            3.5 mm.

    Raises:
        ConfigError: A number is not positive or the clearances are not ordered.
    """

    def __init__(
        self,
        *,
        max_grasps: int = 600,
        max_points: int = 700,
        voxel_m: float = 0.003,
        n_seeds: int = 400,
        n_lines: int = 320,
        n_rim_points: int = 240,
        max_friction: float = 0.7,
        max_tilt_deg: float = 60.0,
        max_towards_camera_deg: float = 25.0,
        clearance_m: float = 0.007,
        min_clearance_m: float = 0.004,
        body_margin_m: float = 0.0035,
        tip_height_m: float = 0.006,
    ) -> None:
        numbers = {
            "max_grasps": max_grasps,
            "max_points": max_points,
            "voxel_m": voxel_m,
            "n_seeds": n_seeds,
            "n_lines": n_lines,
            "n_rim_points": n_rim_points,
            "max_friction": max_friction,
            "max_tilt_deg": max_tilt_deg,
            "clearance_m": clearance_m,
            "min_clearance_m": min_clearance_m,
        }
        for name, value in numbers.items():
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"antipodal generator: {name} must be positive, got {value}")
        if min_clearance_m > clearance_m:
            raise ConfigError(
                f"antipodal generator: min_clearance_m {min_clearance_m} exceeds clearance_m {clearance_m}"
            )
        self.max_grasps = max_grasps
        self.max_points = max_points
        self.voxel_m = voxel_m
        self.n_seeds = n_seeds
        self.n_lines = n_lines
        self.n_rim_points = n_rim_points
        self.max_friction = max_friction
        self.min_clearance_m = min_clearance_m
        tilts = [t for t in (0, 20, -20, 40, -40, 60, -60) if abs(t) <= max_tilt_deg]
        self.placement = PlacementSettings(
            tilts_rad=tuple(float(t) for t in np.deg2rad(tilts)),
            max_tilt_rad=float(np.deg2rad(max_tilt_deg)),
            max_towards_camera_rad=float(np.deg2rad(max_towards_camera_deg)),
            clearance_m=clearance_m,
            min_clearance_m=min_clearance_m,
            body_margin_m=body_margin_m,
            tip_height_m=tip_height_m,
            min_engagement_m=0.002,
        )

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        """Propose grasps on what lies under `crop` (H, W); camera frame, best first, empty where nothing fits."""
        masks = split_objects(scene, crop)
        batches = [self._grasps_on(scene, mask, crop, gripper, rng, len(masks)) for mask in masks]
        return Grasps.concatenate(batches)[: self.max_grasps]

    def _grasps_on(
        self, scene: Scene, mask: Mask, crop: Mask, gripper: Gripper, rng: np.random.Generator, n_objects: int
    ) -> Grasps:
        surface = Completed.of(scene, mask, crop, max_points=self.max_points, voxel_m=self.voxel_m)
        if surface is None:
            return Grasps.empty()
        seen, whole, upright = surface.seen, surface.whole, surface.upright

        longest = gripper.max_width_m - 2 * self.min_clearance_m
        share = max(n_objects, 1)
        lines = ContactLines.concatenate(
            [
                pair_lines(
                    whole,
                    upright,
                    longest,
                    self.max_friction,
                    -(-self.n_seeds // share),
                    -(-self.n_lines // share),
                    0.95,
                    rng,
                ),
                rim_lines(scene, seen, upright, -(-self.n_rim_points // share), rng),
            ]
        )
        if len(lines) == 0:
            return Grasps.empty()
        obstacles = surface.obstacles(scene, mask, gripper)
        placed = place(lines, gripper, upright, obstacles, self._placement_for(upright, seen))
        if len(placed.line) == 0:
            return Grasps.empty()

        off_centre = surface.off_centre(lines.middle[placed.line])
        depth = np.clip(placed.engagement / (0.5 * gripper.pad_length_m), 0, 1)
        score = lines.score[placed.line] * (1 - 0.25 * off_centre) * (0.75 + 0.25 * depth)
        score = score * (1 - 0.15 * np.minimum(placed.tilt / np.deg2rad(60), 1))
        return Grasps(
            placed.rotations.astype(np.float32),
            placed.positions.astype(np.float32),
            placed.widths.astype(np.float32),
            score.astype(np.float32),
        )

    def _placement_for(self, upright: Upright, seen: Surface) -> PlacementSettings:
        """Let the fingertips come nearer to the support where the object is flat."""
        usual = self.placement.tip_height_m
        if not np.isfinite(upright.offset_m):
            return self.placement
        top = float(np.quantile(upright.height(seen.points), 0.95))
        return replace(self.placement, tip_height_m=float(np.clip(0.3 * top, min(_LOWEST_TIP_M, usual), usual)))


def split_objects(scene: Scene, crop: Mask) -> list[Mask]:
    """Return one mask (H, W) per object under the crop.

    A proposal counts when the crop covers a good part of it, or it covers a good part of the crop (a part was asked
    for); it is then taken whole, since the rest of it tells its shape. What no proposal explains is one more object.
    """
    n_crop = int(crop.sum())
    if n_crop == 0:
        return []
    masks: list[Mask] = []
    rest = crop.copy()
    for proposal in scene.proposals:
        common = int((proposal.mask & crop).sum())
        if common >= _MIN_PIXELS and (common >= 0.3 * proposal.mask.sum() or common >= 0.5 * n_crop):
            masks.append(proposal.mask)
            rest &= ~proposal.mask
    n_rest = int(rest.sum())
    if not masks:
        return [crop]
    return [*masks, rest] if n_rest >= max(_MIN_PIXELS * 4, 0.1 * n_crop) else masks
