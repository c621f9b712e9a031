from __future__ import annotations

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.things import box, hammer  # noqa: E402

from thinkgrasp.errors import InputError  # noqa: E402
from thinkgrasp.sim.render import render  # noqa: E402
from thinkgrasp.sim.tabletop import pose  # noqa: E402
from thinkgrasp.sim.truth import true_labels, true_parts, visible_fraction, visible_fractions  # noqa: E402
from thinkgrasp.sim.views import CameraView, camera, default_view, look_at  # noqa: E402
from thinkgrasp.sim.world import World  # noqa: E402

VIEW = default_view("l515", (224, 224))
DOWN = CameraView(camera("l515", (224, 224)), look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), up=(1, 0, 0)))


@pytest.fixture
def world() -> World:
    """A hammer, a lid that hides half of it from above, a box under the lid, and one thing out of the world."""
    things = [
        hammer((0.3, 0.3, 0.3), (0.8, 0.5, 0.2)),
        box((0.2, 0.2, 0.01), (0.2, 0.2, 0.8)),
        box((0.03, 0.03, 0.03), (0.8, 0.1, 0.1)),
        box((0.05, 0.05, 0.05), (0.1, 0.8, 0.1)),
    ]
    world = World(things, robot=False)
    world.place(0, pose(0.5, 0.0, 0.02))
    world.place(1, pose(0.4, 0.0, 0.075))
    world.place(2, pose(0.4, 0.0, 0.015))
    mujoco.mj_forward(world.model, world.data)
    return world


def test_labels_name_the_object_at_each_pixel(world):
    labels = true_labels(world, DOWN)
    assert labels.dtype == np.int32
    assert set(np.unique(labels).tolist()) == {-1, 0, 1}
    seen = render(world.model, world.data, DOWN, world.visuals)
    assert np.array_equal(labels >= 0, world.object_of_geom[seen.geoms] >= 0)
    assert seen.depth[labels == 1] == pytest.approx(0.72, abs=1e-5)


def test_parts_split_an_object(world):
    parts = true_parts(world, DOWN, 0)
    assert list(parts) == ["head", "handle"]
    assert not (parts["head"] & parts["handle"]).any()
    assert np.array_equal(parts["head"] | parts["handle"], true_labels(world, DOWN) == 0)
    assert np.nonzero(parts["handle"])[0].mean() < np.nonzero(parts["head"])[0].mean()  # +x is up in this image


def test_visible_fractions_count_pixels(world):
    fractions = visible_fractions(world, DOWN)
    assert fractions[1] == 1.0
    assert fractions[2] == 0.0
    assert fractions[3] == 0.0  # out of the world
    assert 0.5 < fractions[0] < 0.9

    hidden = world.object_of_geom[true_geoms(world)] == 0
    world.park(1)
    mujoco.mj_forward(world.model, world.data)
    alone = world.object_of_geom[true_geoms(world)] == 0
    assert fractions[0] == pytest.approx(hidden.sum() / alone.sum())


def true_geoms(world: World) -> np.ndarray:
    geoms = render(world.model, world.data, DOWN, world.visuals, shadows=False).geoms
    return np.where(geoms >= 0, geoms, world.model.geom("table").id)


def test_an_object_that_the_image_cuts_counts_what_is_in_the_image(world):
    world.place(3, pose(0.5, -0.43, 0.025))
    mujoco.mj_forward(world.model, world.data)
    labels = true_labels(world, DOWN)
    assert (labels[:, -1] == 3).any()
    assert visible_fraction(world, DOWN, 3) == 1.0


def test_asking_leaves_the_world_as_it_was(world):
    groups, positions = world.model.geom_group.copy(), world.data.qpos.copy()
    visible_fractions(world, VIEW)
    assert np.array_equal(world.model.geom_group, groups)
    assert np.array_equal(world.data.qpos, positions)


def test_unknown_objects_are_refused(world):
    for ask in (visible_fraction, true_parts):
        with pytest.raises(InputError, match=r"0\.\.3"):
            ask(world, VIEW, 4)
