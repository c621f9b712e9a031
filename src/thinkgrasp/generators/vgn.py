"""Grasps from the Volumetric Grasping Network, brought to a gripper of another size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from thinkgrasp.closure import OrientedCloud, pad_friction
from thinkgrasp.contacts import closure_score
from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.fusion import agreeing_views
from thinkgrasp.generators.antipodal import split_objects
from thinkgrasp.generators.cubes import place_cubes, supported
from thinkgrasp.generators.placement import PlacementSettings, reach_past
from thinkgrasp.generators.surface import Completed, Float, Upright
from thinkgrasp.geometry import apply
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Grasps, Mask, Scene
from thinkgrasp.weights import locate_file

try:
    from thinkgrasp.networks import vgn
    from thinkgrasp.networks.checkpoint import choose_device
    from thinkgrasp.networks.tsdf import fuse
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise MissingDependency("torch", "graspnet", "the VGN generator") from error

_SPAN = (0.3, 1.0)
"""Part of the hand's depth in which its target lies: the contacts are there, from the palm."""
_ON_TARGET_M = 0.012
_CONTACT_M = 0.003
_WIDER_M = np.float32(0.016)
_LOWEST_TIP_M = 0.0035


@dataclass(frozen=True, eq=False)
class _Hands:
    """Poses of the hand that the network was trained with, camera frame, best first."""

    rotations: Float
    """(K, 3, 3) columns: closing, binormal, approach."""
    palms: Float
    """(K, 3) middle of the palm's face [m]."""
    scores: Float
    """(K,) processed quality."""

    def __len__(self) -> int:
        return len(self.palms)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> _Hands:
        return _Hands(self.rotations[index], self.palms[index], self.scores[index])


class VgnGenerator:
    """Propose grasps where the network sees them, and fit the gripper to what is between its fingers.

    Upright cubes of the whole view, or of all views that were fused, the support in each at the height that the network
    knows, are put over the crop; voxels whose fingers would not close on a cropped point are left out.

    The score of a fitted grasp is the network's quality, after its post-processing, times 1.1 - mu of what the pads
    would touch (0 where that does not close at mu = 1), times 1 down to 0.75 with the distance from the object's
    middle. Of one that is not fitted it is the quality alone.

    Args:
        weights: File of the network's weights, `vgn_conv.pth`, which does not come with this package; None = the one
            among the known weights, if it is on this machine.
        threshold: Least quality.
        variant: Post-processing of the published code ("corl2020") or of its later branch ("devel").
        only_maxima: Leave out all but the best voxel of a neighbourhood, as the network's authors do. Off by default:
            the checks decide what is left of a neighbourhood, and selection puts like grasps together.
        centring: Move grasps by half a voxel along the cube's x and y, where the network is off by that much.
        scale: Size of the world in the network's eyes: the cube's side is 0.30 m and the hand opens 0.08 m, times this.
            None = the gripper's opening over 0.08 m, as far as its fingers are that much longer.
        n_yaws: Cubes at so many turns about the vertical, spread over 90 degrees.
        fit: Centre each grasp on what is between the fingers, open only as far as it needs, put the palm where the
            trained hand's was, and draw back from what is in the way. False: fully open, fingertips where the trained
            hand has them, kept above the support.
        max_cubes: At most so many cubes per turn.
        max_grasps: At most so many grasps, best first.
        clearance_m: Room between each open finger and the object where the gripper opens that far.
        min_clearance_m: Room that is always kept.
        body_margin_m: Distance between the gripper's bodies and all points nearby.
        tip_height_m: Lowest height of fingers and palm above the support; less for what is less than 2 cm tall.
        device: Of the network; None = a GPU where there is one.

    Raises:
        ConfigError: No weights, not this network's, or a setting is out of range.
        MissingDependency: torch is not installed.
    """

    def __init__(
        self,
        *,
        weights: str | Path | None = None,
        threshold: float = 0.3,
        variant: vgn.Variant = "corl2020",
        only_maxima: bool = False,
        centring: bool = True,
        scale: float | None = None,
        n_yaws: int = 3,
        fit: bool = True,
        max_cubes: int = 16,
        max_grasps: int = 600,
        clearance_m: float = 0.007,
        min_clearance_m: float = 0.004,
        body_margin_m: float = 0.0035,
        tip_height_m: float = 0.006,
        device: str | None = None,
    ) -> None:
        if variant not in get_args(vgn.Variant):
            allowed = ", ".join(get_args(vgn.Variant))
            raise ConfigError(f"VGN generator: no variant {variant!r}; allowed are {allowed}")
        if not 0 < threshold < 1:
            raise ConfigError(f"VGN generator: threshold must lie in (0, 1), got {threshold}")
        if scale is not None and not 0 < scale < 10:
            raise ConfigError(f"VGN generator: scale must lie in (0, 10), or be None, got {scale}")
        for name, value in (("n_yaws", n_yaws), ("max_cubes", max_cubes), ("max_grasps", max_grasps)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigError(f"VGN generator: {name} must be a whole number of at least 1, got {value!r}")
        if not 0 < min_clearance_m <= clearance_m:
            raise ConfigError(
                f"VGN generator: need 0 < min_clearance_m <= clearance_m, got {min_clearance_m}, {clearance_m}"
            )
        for name, value in (("body_margin_m", body_margin_m), ("tip_height_m", tip_height_m)):
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"VGN generator: {name} must be at least 0, got {value}")
        file = locate_file(weights, default="vgn", what="VGN generator")
        self.network = vgn.load_vgn(file, choose_device(device, what="VGN"))
        self.threshold = threshold
        self.variant: vgn.Variant = variant
        self.only_maxima = only_maxima
        self.centring = centring
        self.scale = scale
        self.yaws_rad = tuple(float(y) for y in np.arange(n_yaws) * (np.pi / 2 / n_yaws))
        self.fit = fit
        self.max_cubes = max_cubes
        self.max_grasps = max_grasps
        self.placement = PlacementSettings(
            tilts_rad=(),
            max_tilt_rad=np.pi,
            max_towards_camera_rad=np.pi,
            clearance_m=clearance_m,
            min_clearance_m=min_clearance_m,
            body_margin_m=body_margin_m,
            tip_height_m=tip_height_m,
            min_engagement_m=0.002,
        )

    def generate(self, scene: Scene, crop: Mask, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        """Propose grasps on what lies under `crop` (H, W); camera frame, best first, empty where nothing is found.

        Raises:
            ConfigError: The scene has neither a support plane nor a camera pose.
        """
        seen = scene.points[crop & np.isfinite(scene.points[..., 2])]
        if len(seen) == 0:
            return Grasps.empty()
        scene = supported(scene, seen)
        scale = self._scale(gripper)
        hands = self._hands(scene, seen, Upright.of(scene, seen), scale)
        hands = hands[self._on(hands, seen, scale)][: self.max_grasps]
        if len(hands) == 0:
            return Grasps.empty()
        trained = vgn.HAND_DEPTH_M * scale
        if not self.fit:
            return self._opened(hands, np.float32(trained), Upright.of(scene, seen), gripper)
        depth = np.float32(max(trained, gripper.finger_length_m))
        masks = split_objects(scene, crop)
        return Grasps.concatenate([self._fitted(scene, mask, crop, hands, depth, gripper) for mask in masks])

    def _scale(self, gripper: Gripper) -> float:
        if self.scale is not None:
            return self.scale
        return min(gripper.max_width_m / vgn.HAND_OPENING_M, max(gripper.finger_length_m / vgn.HAND_DEPTH_M, 1.0))

    def _hands(self, scene: Scene, seen: Float, upright: Upright, scale: float) -> _Hands:
        """All voxels worth a grasp in all cubes."""
        side = vgn.CUBE_M * scale
        cubes = place_cubes(
            seen,
            upright,
            side_m=side,
            support_m=vgn.SUPPORT_M * scale,
            yaws_rad=self.yaws_rad,
            max_cubes=self.max_cubes,
        )
        views = agreeing_views(scene.frame)
        depth, cameras = [frame.depth for frame, _ in views], [frame.camera for frame, _ in views]
        grids = [
            fuse(
                depth,
                cameras,
                np.stack([T_view_camera @ T for _, T_view_camera in views]),
                length_m=side,
                resolution=vgn.RESOLUTION,
                max_depth_m=np.inf,
            ).grid()
            for T in cubes
        ]
        parts: list[_Hands] = []
        for T, grid, raw in zip(cubes, grids, vgn.predict(self.network, np.stack(grids)), strict=True):
            quality = vgn.process_quality(grid, raw, variant=self.variant)
            voxels = vgn.select_voxels(
                quality, raw, variant=self.variant, threshold=self.threshold, only_maxima=self.only_maxima
            )
            if len(voxels.index) == 0:
                continue
            R = T[:3, :3] @ Rotation.from_quat(voxels.quat_xyzw).as_matrix()
            closing, approach = R[:, :, 1], R[:, :, 2]
            palms = apply(T, voxels.position_m(side, centring=self.centring))
            closing = closing * _sign(closing, upright)[:, None]
            rotations = np.stack([closing, np.cross(approach, closing), approach], axis=2)
            parts.append(_Hands(rotations.astype(np.float32), palms.astype(np.float32), voxels.score))
        if not parts:
            return _Hands(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
        hands = _Hands(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("rotations", "palms", "scores")))
        return hands[np.argsort(-hands.scores, kind="stable")]

    def _on(self, hands: _Hands, seen: Float, scale: float) -> NDArray[np.bool_]:
        """(K,) True where a cropped point lies near the line between the fingers."""
        if len(hands) == 0:
            return np.zeros(0, np.bool_)
        steps = (np.linspace(*_SPAN, 5) * vgn.HAND_DEPTH_M * scale).astype(np.float32)
        line = hands.palms[:, None] + steps[:, None] * hands.rotations[:, None, :, 2]
        distance = KDTree(seen).query(line.reshape(-1, 3), distance_upper_bound=_ON_TARGET_M * scale)[0]
        return np.isfinite(distance).reshape(len(hands), -1).any(axis=1)

    def _opened(self, hands: _Hands, depth: np.float32, upright: Upright, gripper: Gripper) -> Grasps:
        """The gripper wide open where the trained hand was, kept above the support."""
        width = np.full(len(hands), _widest(gripper), np.float32)
        tips = np.asarray(hands.palms + depth * hands.rotations[:, :, 2], np.float32)
        nothing = np.zeros((0, 3), np.float32)
        reach = reach_past(hands.rotations, tips, width, gripper, upright, nothing, self.placement)
        back = np.minimum(reach, 0)
        good = back > -depth
        positions = tips + np.where(good, back, np.float32(0))[:, None] * hands.rotations[:, :, 2]
        return Grasps(hands.rotations, positions.astype(np.float32), width, hands.scores)[good]

    def _fitted(
        self, scene: Scene, mask: Mask, crop: Mask, hands: _Hands, depth: np.float32, gripper: Gripper
    ) -> Grasps:
        """Grasps on one object."""
        surface = Completed.of(scene, mask, crop, max_points=700, voxel_m=0.003)
        if surface is None:
            return Grasps.empty()
        widest, settings = _widest(gripper), self._placement_for(surface)
        low, high, top = _between(hands, surface.whole.points, depth, gripper)
        some = high >= low
        hands, low, high, top = hands[some], low[some], high[some], top[some]
        width = np.clip(high - low + 2 * np.float32(settings.clearance_m), gripper.min_width_m, widest)
        fits = width >= high - low + 2 * np.float32(settings.min_clearance_m)
        hands, width, top, middle = hands[fits], width[fits], top[fits], ((low + high) / 2)[fits]
        if len(hands) == 0:
            return Grasps.empty()
        closing, approach = hands.rotations[:, :, 0], hands.rotations[:, :, 2]
        tips = np.asarray(hands.palms + depth * approach + middle[:, None] * closing, np.float32)
        obstacles = surface.obstacles(scene, mask, gripper)

        reach = reach_past(hands.rotations, tips, width, gripper, surface.upright, obstacles, settings)
        least = top + np.float32(settings.min_engagement_m) - depth
        wide = np.where(reach < np.maximum(least, 0), np.minimum(width + _WIDER_M, widest), width)
        wider = reach_past(hands.rotations, tips, wide, gripper, surface.upright, obstacles, settings)
        width = np.where(wider > reach, wide, width)
        reach = np.maximum(reach, wider)
        positions = tips + np.minimum(reach, 0)[:, None] * approach
        grasps = Grasps(hands.rotations, positions.astype(np.float32), width, hands.scores)[reach >= least]
        whole = surface.whole
        closing_at = pad_friction(grasps, OrientedCloud(whole.points, whole.normals, radius_m=_CONTACT_M), gripper)
        score = grasps.scores * closure_score(closing_at) * (1 - 0.25 * surface.off_centre(_pads(grasps, gripper)))
        return Grasps(grasps.rotations, grasps.positions, grasps.widths, score.astype(np.float32))

    def _placement_for(self, surface: Completed) -> PlacementSettings:
        """Let the fingertips come nearer to the support where the object is flat."""
        top = float(np.quantile(surface.upright.height(surface.seen.points), 0.95))
        usual = self.placement.tip_height_m
        return replace(self.placement, tip_height_m=float(np.clip(0.3 * top, min(_LOWEST_TIP_M, usual), usual)))


def _widest(gripper: Gripper) -> np.float32:
    return np.nextafter(np.float32(gripper.max_width_m), np.float32(0))


def _pads(grasps: Grasps, gripper: Gripper) -> Float:
    """Middle (N, 3) of what the pads may touch."""
    return np.asarray(grasps.positions - gripper.pad_length_m / 2 * grasps.rotations[:, :, 2], np.float32)


def _sign(closing: NDArray[np.floating], upright: Upright) -> NDArray[np.floating]:
    """The half turn (K,) about the approach that the antipodal generator chooses too."""
    side = np.cross(upright.up, upright.away)
    return np.where((closing @ side) * 2 + closing @ upright.away < 0, -1.0, 1.0)


def _between(hands: _Hands, points: Float, depth: np.float32, gripper: Gripper) -> tuple[Float, Float, Float]:
    """Extent of what is between the fully open fingers: lowest and highest along closing, nearest to the palm.

    Three arrays (K,) [m]; inf, -inf, inf where there is nothing.
    """
    x, y, z = (
        points @ hands.rotations[:, :, axis].T - np.einsum("ki,ki->k", hands.rotations[:, :, axis], hands.palms)
        for axis in range(3)
    )
    inside = (np.abs(x) < gripper.max_width_m / 2) & (np.abs(y) < gripper.finger_breadth_m / 2) & (z > 0) & (z < depth)
    inf = np.float32(np.inf)
    low, high = np.where(inside, x, inf).min(axis=0), np.where(inside, x, -inf).max(axis=0)
    return low, high, np.where(inside, z, inf).min(axis=0)
