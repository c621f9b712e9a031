"""Time of one picture of the simulated cell, by ray casting and, where it works, by EGL.

    python benchmarks/rendering.py [--objects 15] [--repeats 7]

The scene is a pile of catalogue objects before the arm. Times are wall clock, best and median of the repeats; "rays" is
the ray caster as the simulated camera uses it, "1 thread" the same on one core, "no shadow" without the second cast,
"frame" a whole camera frame with sensor noise, "fractions" the visible fraction of every object. "egl" draws geometry
in OpenGL and casts rays for shadows only; "agree" is the share of pixels with the same geom, and the median difference
in depth of those.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import mujoco
import numpy as np
import tyro

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.sim import catalogue, egl
from thinkgrasp.sim.rays import THREADS
from thinkgrasp.sim.render import render
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.truth import visible_fractions
from thinkgrasp.sim.views import CameraView, default_view
from thinkgrasp.sim.world import World


def pile(count: int, seed: int = 0) -> World:
    """Drop that many catalogue objects."""
    rng = np.random.default_rng(seed)
    names = rng.choice(catalogue.names(), count, replace=False)
    world = World([catalogue.make(str(name)) for name in names])
    world.drop(
        [
            (i, pose(rng.uniform(0.36, 0.64), rng.uniform(-0.14, 0.14), 0.12, rng.uniform(0, 2 * np.pi)))
            for i in range(count)
        ]
    )
    mujoco.mj_forward(world.model, world.data)  # pyright: ignore[reportAttributeAccessIssue]
    return world


def clock(work: Callable[[], object], repeats: int) -> str:
    """Return best and median time of a call [ms]."""
    work()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return f"{min(times):7.0f} {np.median(times):7.0f}"


def report(world: World, view: CameraView, repeats: int) -> None:
    """Print one image size."""
    model, data, visuals = world.model, world.data, world.visuals
    camera = SimulatedCamera(world, view)
    works: dict[str, Callable[[], object]] = {
        f"rays, {THREADS} threads": lambda: render(model, data, view, visuals),
        "rays, 1 thread": lambda: render(model, data, view, visuals, threads=1),
        "rays, no shadow": lambda: render(model, data, view, visuals, shadows=False),
        "frame": camera.read,
        "fractions": lambda: visible_fractions(world, view),
    }
    size = f"{view.intrinsics.width}x{view.intrinsics.height}"
    for name, work in works.items():
        print(f"{size:8} {name:16} {clock(work, repeats)}", flush=True)
    if not egl.available():
        return
    with egl.EglRenderer(model) as renderer:
        print(f"{size:8} {'egl':16} {clock(lambda: renderer.render(data, view, visuals), repeats)}")
        bare = clock(lambda: renderer.render(data, view, visuals, shadows=False), repeats)
        print(f"{size:8} {'egl, no shadow':16} {bare}")
        cast, drawn = render(model, data, view, visuals), renderer.render(data, view, visuals)
        same = cast.geoms == drawn.geoms
        apart_m = np.median(np.abs(cast.depth - drawn.depth)[same])
        print(f"{size:8} {'agree':16} {same.mean():8.3%} of the pixels, {1e6 * apart_m:.1f} um")


def main(objects: int = 15, repeats: int = 7) -> None:
    """Time every way to render."""
    world = pile(objects)
    triangles = sum(len(piece.faces) for piece in world.visuals.values())
    print(f"{objects} objects of {triangles // objects} triangles each, {world.model.ngeom} geoms")
    print(f"{'size':8} {'what':16} {'best':>7} {'median':>7} ms")
    for size in ((224, 224), (640, 480)):
        report(world, default_view("l515", size), repeats)
    if not egl.available():
        print("egl does not work here: it needs libEGL with a driver, and PyOpenGL")


if __name__ == "__main__":
    tyro.cli(main)
