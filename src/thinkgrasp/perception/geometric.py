"""Scene perception without networks: support plane, proposals and obstruction graph from one RGB-D frame."""

from __future__ import annotations

import numpy as np

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import deproject, organised_normals
from thinkgrasp.perception.assembly import assemble
from thinkgrasp.perception.blind import find_blind
from thinkgrasp.perception.color import balance_white, lab_from_rgb
from thinkgrasp.perception.edges import Edges, find_edges
from thinkgrasp.perception.foreground import Foreground, find_foreground
from thinkgrasp.perception.grouping import merge_patches, patch_adjacency, patch_statistics
from thinkgrasp.perception.morphology import Labels
from thinkgrasp.perception.obstruction import obstruction_graph
from thinkgrasp.perception.proposals import make_proposals
from thinkgrasp.perception.superpixels import superpixels
from thinkgrasp.perception.support import Support, find_support
from thinkgrasp.types import Array, CameraIntrinsics, Degradation, Frame, Scene


class GeometricPerception:
    """Finds what stands on the support from depth and colour alone.

    Args:
        work_width_px: Frames wider than this are processed at a whole fraction of their size.
        patch_px: Size of the patches that things are put together from, at that size.
        seed: Seeds the plane search, anew for every frame.

    Raises:
        ConfigError: work_width_px is smaller than 160, or patch_px is not in 4..40.
    """

    def __init__(self, *, work_width_px: int = 640, patch_px: int = 10, seed: int = 0) -> None:
        if work_width_px < 160:
            raise ConfigError(f"work_width_px must be at least 160, got {work_width_px}")
        if not 4 <= patch_px <= 40:
            raise ConfigError(f"patch_px must be in 4..40, got {patch_px}")
        self.work_width_px = work_width_px
        self.patch_px = patch_px
        self.seed = seed

    def perceive(self, frame: Frame, labels: Labels | None = None) -> Scene:
        """Find the support plane, the proposals and their obstruction graph.

        Args:
            frame: The view.
            labels: (H, W) where something else has told the things apart already, 1..n, 0 = none; only their geometry
                is found then.

        Returns:
            A scene with points and normals at the frame's size. Without a support plane there are no proposals.
        """
        camera = frame.camera
        points = deproject(frame.depth, camera)
        scale = max(1, round(camera.width / self.work_width_px))
        work_points = np.ascontiguousarray(points[::scale, ::scale])
        work_camera = _scaled(camera, scale, work_points.shape[:2])
        work_normals = organised_normals(work_points, work_camera)
        normals = _enlarged(work_normals, scale, points.shape[:2])
        up = None if frame.T_world_camera is None else frame.T_world_camera[2, :3]
        support = find_support(work_points, work_normals, up, np.random.default_rng(self.seed))
        if support is None:
            what = "that is level by T_world_camera (the world's z axis must point up)" if up is not None else "in view"
            reason = f"no support surface {what}"
            return Scene(frame, points, normals, degraded=(Degradation("scene", reason, "no object proposals"),))

        lab = balance_white(lab_from_rgb(_shrunk(frame.color, scale)), ~support.plane.inliers)
        workspace = None if frame.workspace is None else frame.workspace[::scale, ::scale]
        foreground = find_foreground(work_points, lab, support, workspace)
        if labels is not None:
            labels, sized = np.ascontiguousarray(labels[::scale, ::scale]), work_points
            edges = find_edges(labels, work_points, work_normals, reach_px=3) if labels.any() else Edges.none()
        else:
            labels, edges = self._tell_apart(foreground, work_points, work_normals, lab, support)
            labels, sized = find_blind(labels, foreground, work_points, support, work_camera)
        measured = np.isfinite(work_points[..., 2])
        proposals = make_proposals(labels, scale, sized, measured, work_normals, lab, support, camera)

        marks: Labels = np.zeros(labels.shape, np.int32)
        for proposal in proposals:
            marks[proposal.mask[::scale, ::scale]] = proposal.mark
        graph = obstruction_graph(marks, scale, sized, edges.relabelled(marks), proposals, support)
        return Scene(
            frame,
            points,
            normals,
            support.plane.resized(scale, points.shape[:2]),
            _enlarged(foreground.region, scale, points.shape[:2]),
            proposals,
            graph,
        )

    def _tell_apart(
        self, foreground: Foreground, points: Array, normals: Array, lab: Array, support: Support
    ) -> tuple[Labels, Edges]:
        labels = superpixels(foreground.mask, points, normals, lab, self.patch_px)
        if not labels.any():
            return labels, Edges.none()
        patches = patch_statistics(labels, points, normals, lab)
        groups = merge_patches(len(patches.count), patch_adjacency(labels, points, normals, patches))
        labels = np.where(labels > 0, np.r_[-1, groups][labels] + 1, 0).astype(np.int32)
        return assemble(labels, foreground, points, normals, lab, support)


def _scaled(camera: CameraIntrinsics, scale: int, shape: tuple[int, ...]) -> CameraIntrinsics:
    return CameraIntrinsics(
        shape[1], shape[0], camera.fx / scale, camera.fy / scale, camera.cx / scale, camera.cy / scale
    )


def _shrunk(color: np.ndarray, scale: int) -> np.ndarray:
    """Average blocks of scale x scale pixels; the last, incomplete block of a row or column is taken as it is."""
    if scale == 1:
        return color
    out = color[::scale, ::scale].copy()
    h, w = color.shape[0] // scale, color.shape[1] // scale
    blocks = color[: h * scale, : w * scale].reshape(h, scale, w, scale, 3)
    out[:h, :w] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return out


def _enlarged(image: Array | np.ndarray, scale: int, shape: tuple[int, ...]) -> np.ndarray:
    if scale == 1:
        return image
    return image.repeat(scale, axis=0).repeat(scale, axis=1)[: shape[0], : shape[1]]
