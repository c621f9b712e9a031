"""A camera that looks at the simulated world; its frames carry nothing that a real camera would not tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, deproject
from thinkgrasp.motion.cell import WORKSPACE_M
from thinkgrasp.sim.depth_noise import noise_model
from thinkgrasp.sim.egl import EglRenderer
from thinkgrasp.sim.render import render
from thinkgrasp.sim.views import CameraView, default_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Array, Frame, Mask

WORKSPACE_HEIGHT_M = (-0.02, 0.50)
WORKSPACE_MARGIN_M = (0.06, 0.19)
"""Added around the workspace along x and y: a thing belongs to it as a whole, and one that was pushed over its edge."""


def default_workspace() -> NDArray[np.float64]:
    """Return the lowest and the highest corner (2, 3) of where grasping is allowed, world [m]."""
    (x0, x1), (y0, y1) = WORKSPACE_M
    (mx, my), (z0, z1) = WORKSPACE_MARGIN_M, WORKSPACE_HEIGHT_M
    return np.array([[x0 - mx, y0 - my, z0], [x1 + mx, y1 + my, z1]])


class SimulatedCamera:
    """Renders the world as it is at each `read` and adds the sensor's noise.

    Args:
        world: What to look at.
        view: Camera and pose; the default view at 640x480 when None.
        noise: Name of a sensor model, or None for exact depth; see `thinkgrasp.sim.depth_noise`.
        seed: Same seed and same number of reads, same noise.
        workspace_m: (2, 3) lowest and highest corner of the box, world [m], where grasping is allowed.
        renderer: Draws in OpenGL; None = ray casting on the CPU, bit-equal on every run.

    Raises:
        ConfigError: No such noise model.
        InputError: The workspace is no box.
    """

    def __init__(
        self,
        world: World,
        view: CameraView | None = None,
        *,
        noise: str | None = "l515",
        seed: int = 0,
        workspace_m: NDArray[np.float64] | None = None,
        renderer: EglRenderer | None = None,
    ) -> None:
        self.view = view or default_view()
        self._world = world
        self._renderer = renderer
        self._noise = noise_model(noise)
        self._seed = seed
        self._reads = 0
        self._workspace = default_workspace() if workspace_m is None else np.asarray(workspace_m, np.float64)
        if self._workspace.shape != (2, 3) or not (self._workspace[0] < self._workspace[1]).all():
            raise InputError(f"the workspace must be two corners (2, 3), lowest first, got {self._workspace.tolist()}")

    def read(self) -> Frame:
        """Return the next frame; the mask of the workspace comes from the depth as measured."""
        rng = np.random.default_rng([self._seed, self._reads])
        self._reads += 1
        world = self._world
        if self._renderer is None:
            seen = render(world.model, world.data, self.view, world.visuals, hits=world.hits(self.view))
        else:
            seen = self._renderer.render(world.data, self.view, world.visuals)
        depth = seen.depth if self._noise is None else self._noise.apply(seen.depth, seen.cosine(self.view), rng)
        return Frame(seen.color, depth, self.view.intrinsics, self.view.T_world_camera.copy(), self._inside(depth))

    def _inside(self, depth: Array) -> Mask:
        points = apply(self.view.T_world_camera, deproject(depth, self.view.intrinsics))
        with np.errstate(invalid="ignore"):
            low, high = self._workspace.astype(np.float32)
            return ((points > low) & (points < high)).all(axis=-1)
