from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.things import ball, box  # noqa: E402
from scipy import ndimage  # noqa: E402

from thinkgrasp.cameras.simulated import SimulatedCamera  # noqa: E402
from thinkgrasp.sim import egl  # noqa: E402
from thinkgrasp.sim.render import render  # noqa: E402
from thinkgrasp.sim.tabletop import pose  # noqa: E402
from thinkgrasp.sim.views import SIZES, default_view  # noqa: E402
from thinkgrasp.sim.world import World  # noqa: E402


@pytest.mark.skipif(not egl.available(), reason="no EGL here: needs libEGL with a driver, and PyOpenGL")
def test_the_rasteriser_sees_the_same_geometry():
    world = World([ball(0.04, (0.8, 0.1, 0.1)), box((0.06, 0.08, 0.12), (0.1, 0.2, 0.8))])
    world.place(0, pose(0.45, -0.05, 0.04))
    world.place(1, pose(0.55, 0.08, 0.06, 0.5))
    mujoco.mj_forward(world.model, world.data)
    with egl.EglRenderer(world.model) as renderer:
        for size in SIZES:
            view = default_view("l515", size)
            cast = render(world.model, world.data, view, world.visuals)
            drawn = renderer.render(world.data, view, world.visuals)
            same = cast.geoms == drawn.geoms
            assert same.mean() > 0.998
            edge = ndimage.maximum_filter(cast.geoms, 3) != ndimage.minimum_filter(cast.geoms, 3)
            error = np.abs(cast.depth - drawn.depth)[same & ~edge]
            assert np.median(error) < 1e-5
            assert np.percentile(error, 99.9) < 2e-3
            difference = np.abs(cast.color.astype(int) - drawn.color.astype(int)).max(axis=2)
            assert np.median(difference) <= 2
        frame = SimulatedCamera(world, view, noise=None, renderer=renderer).read()
        assert np.array_equal(frame.depth, drawn.depth)


WITHOUT_OPENGL = """
import sys
sys.modules["OpenGL"] = None
from thinkgrasp.errors import ConfigError
from thinkgrasp.sim import egl
assert not egl.available()
try:
    egl.EglRenderer(None)
except ConfigError as error:
    print(error)
"""


def test_without_opengl_the_error_says_what_is_missing():
    run = subprocess.run([sys.executable, "-c", WITHOUT_OPENGL], capture_output=True, text=True, check=True)
    assert "EGL rendering does not work here" in run.stdout
    assert "pip install 'thinkgrasp[egl]'" in run.stdout
    assert len(run.stdout.splitlines()) == 1
