"""The same renderings with their geometry from OpenGL: MuJoCo's own rasteriser on an off-screen EGL surface.

Depth and geom ids come from one pass of the graphics driver; colours and shadows are computed as in `render`. Worth it
where a GPU is idle; a software driver (Mesa) works too. Needs libEGL and the package PyOpenGL.
"""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import TracebackType

import mujoco
import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import deproject, organised_normals
from thinkgrasp.sim.objects import VisualPiece
from thinkgrasp.sim.rays import SEEN_GROUPS, THREADS
from thinkgrasp.sim.render import FAR_M, Light, Rendering, Surfaces, shade
from thinkgrasp.sim.views import CameraView

NEAR_M = 0.05
"""Nothing nearer is drawn."""


@cache
def available() -> bool:
    """Return whether an EGL context can be made here; tried once per process."""
    try:
        _context(16, 16).free()
    except ConfigError:
        return False
    return True


def _context(width: int, height: int):
    try:
        from mujoco.egl import GLContext

        return GLContext(width, height)
    except Exception as error:  # a missing library, device or package each raises its own type
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(
            f"EGL rendering does not work here ({reason}); it needs libEGL with a driver and PyOpenGL "
            "(pip install 'thinkgrasp[egl]'); the ray caster needs neither"
        ) from error


class EglRenderer:
    """Holds a world's meshes in an EGL context; use as a context manager, or call `close`.

    Raises:
        ConfigError: EGL does not work here.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._gl = _context(640, 480)
        self._gl.make_current()
        samples = model.vis.quality.offsamples
        model.vis.quality.offsamples = 0  # averaged samples would mix depths and ids
        try:
            self._buffers = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        finally:
            model.vis.quality.offsamples = samples
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._buffers)
        self._buffers.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 16)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = True
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[list(SEEN_GROUPS)] = 1

    def __enter__(self) -> EglRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the driver's memory back; the renderer cannot be used afterwards."""
        self._gl.make_current()
        self._buffers.free()
        self._gl.free()

    def render(
        self,
        data: mujoco.MjData,
        view: CameraView,
        visuals: Mapping[int, VisualPiece],
        *,
        shadows: bool = True,
        light: Light | None = None,
        threads: int = THREADS,
    ) -> Rendering:
        """Render as `thinkgrasp.sim.render.render` does; depth differs from it by rounding, and at silhouettes."""
        geoms, depth = self._rasterise(data, view)
        points = deproject(depth, view.intrinsics)
        with np.errstate(invalid="ignore", divide="ignore"):
            normals = organised_normals(points, view.intrinsics, radius_px=1).reshape(-1, 3).astype(np.float64)
        R = view.T_world_camera[:3, :3]
        normals = np.where(np.isfinite(normals), normals, [0.0, 0.0, -1.0]) @ R.T
        seen = Surfaces(geoms.ravel(), depth.ravel().astype(np.float64), normals)
        return shade(self._model, data, view, visuals, seen, shadows=shadows, light=light, threads=threads)

    def _rasterise(self, data: mujoco.MjData, view: CameraView) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Geom ids (H, W), -1 = nothing, and depth (H, W) [m]."""
        width, height = view.intrinsics.width, view.intrinsics.height
        self._gl.make_current()
        if (self._buffers.offWidth, self._buffers.offHeight) != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, self._buffers)
        camera = mujoco.MjvCamera()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        _aim(self._scene, view)
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._buffers)
        codes, z = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(codes, z, rect, self._buffers)

        code = codes.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        geom_of_code = np.full(self._scene.ngeom + 1, -1, np.int32)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geom_of_code[drawn.segid + 1] = drawn.objid
        geoms = geom_of_code[code]
        # The depth buffer is reversed: near / depth, shifted so that it is 0 at the far plane.
        near, far = np.float64(NEAR_M), np.float64(FAR_M)
        depth = near * far / (near + z.astype(np.float64) * (far - near))
        depth[geoms < 0] = 0
        return geoms[::-1], depth[::-1].astype(np.float32)


def _aim(scene: mujoco.MjvScene, view: CameraView) -> None:
    """Give the scene's cameras the view's pose and frustum."""
    c, T = view.intrinsics, view.T_world_camera
    for gl in scene.camera:
        gl.pos, gl.forward, gl.up = T[:3, 3], T[:3, 2], -T[:3, 1]
        gl.frustum_near, gl.frustum_far = NEAR_M, FAR_M
        gl.frustum_bottom = -(c.height - 0.5 - c.cy) / c.fy * NEAR_M
        gl.frustum_top = (c.cy + 0.5) / c.fy * NEAR_M
        left, right = -(c.cx + 0.5) / c.fx * NEAR_M, (c.width - 0.5 - c.cx) / c.fx * NEAR_M
        gl.frustum_center, gl.frustum_width = (left + right) / 2, (right - left) / 2
