"""Small things in the simulated cell: frames of it, and grasps that a person would make."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.scenes import PiledScene, SceneSpec
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.views import CameraView, default_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Grasp

VIEW = default_view("l515", (224, 224))


def look(world: World, view: CameraView = VIEW) -> Frame:
    """The world as it is now, without noise."""
    mujoco.mj_forward(world.model, world.data)  # pyright: ignore[reportAttributeAccessIssue]
    return SimulatedCamera(world, view, noise=None).read()


def top_down(x: float, y: float, z: float, *, width: float, yaw: float = 0.0, view: CameraView = VIEW) -> Grasp:
    """A grasp from straight above with its fingertips at (x, y, z) in the world, closing along x turned by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    T = invert(view.T_world_camera) @ make_transform(R, np.array([x, y, z]))
    return Grasp(T[:3, :3], T[:3, 3], width, 0.9)


def small_pile(names: Sequence[str] = ("pear", "mug", "banana"), goals: tuple[int, ...] = (0,)) -> PiledScene:
    """A few catalogue objects, apart from each other, at rest."""
    objects = tuple(catalogue.make(name, 1) for name in names)
    spots = [(0.50, 0.0), (0.42, 0.12), (0.60, -0.12), (0.38, -0.10)]
    drops = np.array([pose(x, y, 0.08) for (x, y), _ in zip(spots, objects, strict=False)])
    world = World(objects, robot=False)
    world.drop(list(enumerate(drops)))
    spec = SceneSpec(f"give me the {names[goals[0]]}", objects, goals, drops, 0, None)
    return PiledScene(spec, world.poses(), tuple(1.0 for _ in goals), 1)
