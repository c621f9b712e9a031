from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.things import ball, box  # noqa: E402

from thinkgrasp.cameras.simulated import SimulatedCamera, default_workspace  # noqa: E402
from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.geometry import apply, deproject  # noqa: E402
from thinkgrasp.interfaces import Camera  # noqa: E402
from thinkgrasp.sim.render import render  # noqa: E402
from thinkgrasp.sim.tabletop import pose  # noqa: E402
from thinkgrasp.sim.truth import true_labels  # noqa: E402
from thinkgrasp.sim.views import default_view  # noqa: E402
from thinkgrasp.sim.world import World  # noqa: E402
from thinkgrasp.types import CameraIntrinsics, Frame  # noqa: E402

VIEW = default_view("l515", (224, 224))


@pytest.fixture(scope="module")
def world() -> World:
    world = World([ball(0.04, (0.8, 0.1, 0.1)), box((0.08, 0.08, 0.08), (0.1, 0.2, 0.8))])
    world.place(0, pose(0.5, 0.0, 0.04))
    world.place(1, pose(0.12, 0.16, 0.04))  # nearer to the robot than the workspace
    mujoco.mj_forward(world.model, world.data)
    return world


def test_it_is_a_camera(world):
    camera = SimulatedCamera(world, VIEW)
    assert isinstance(camera, Camera)
    frame = camera.read()
    assert frame.camera is VIEW.intrinsics
    assert np.array_equal(frame.T_world_camera, VIEW.T_world_camera)


def test_exact_depth_is_the_renderers(world):
    frame = SimulatedCamera(world, VIEW, noise=None).read()
    assert np.array_equal(frame.depth, render(world.model, world.data, VIEW, world.visuals).depth)


def test_noise_is_on_by_default_and_follows_seed_and_count(world):
    first, again, other = (SimulatedCamera(world, VIEW, seed=s) for s in (0, 0, 1))
    reads = [[camera.read().depth for _ in range(2)] for camera in (first, again, other)]
    assert np.array_equal(reads[0][0], reads[1][0])
    assert np.array_equal(reads[0][1], reads[1][1])
    assert not np.array_equal(reads[0][0], reads[0][1])
    assert not np.array_equal(reads[0][0], reads[2][0])
    exact = SimulatedCamera(world, VIEW, noise=None).read().depth
    on_table = true_labels(world, VIEW) < 0
    error = (reads[0][0] - exact)[on_table & (reads[0][0] > 0) & (exact < 1.2)]
    assert 0.0005 < np.median(np.abs(error)) < 0.002


def test_the_workspace_is_where_the_measured_points_lie_in_the_box(world):
    frame = SimulatedCamera(world, VIEW).read()
    labels = true_labels(world, VIEW)
    assert frame.workspace is not None
    assert frame.workspace[labels == 0].mean() > 0.9
    assert not frame.workspace[labels == 1].any()
    assert not frame.workspace[frame.depth == 0].any()
    points = apply(VIEW.T_world_camera, deproject(frame.depth, frame.camera))[frame.workspace]
    low, high = default_workspace()
    assert (points > low - 1e-6).all()
    assert (points < high + 1e-6).all()


def test_frames_carry_no_truth(world):
    assert {f.name for f in fields(Frame)} == {"color", "depth", "camera", "T_world_camera", "workspace", "others"}
    frame = SimulatedCamera(world, VIEW).read()
    assert set(vars(frame)) == {f.name for f in fields(Frame)}
    assert isinstance(frame.camera, CameraIntrinsics)
    for name in ("color", "depth", "T_world_camera", "workspace"):
        array = getattr(frame, name)
        assert type(array) is np.ndarray
        memory = array
        while memory.base is not None:
            memory = memory.base
            assert isinstance(memory, np.ndarray)
            assert memory.size <= 4 * array.size  # a view of its own pixels, not of the simulator's state
        assert not np.shares_memory(array, world.data.qpos)


def test_two_cameras_may_look_at_one_world(world):
    near, far = SimulatedCamera(world, VIEW), SimulatedCamera(world, default_view("d455", (320, 240)), noise="d455")
    assert near.read().depth.shape == (224, 224)
    assert far.read().depth.shape == (240, 320)


def test_wrong_settings_are_refused(world):
    with pytest.raises(ConfigError, match="kinect"):
        SimulatedCamera(world, VIEW, noise="kinect")
    with pytest.raises(InputError, match="lowest first"):
        SimulatedCamera(world, VIEW, workspace_m=np.ones((2, 3)))
