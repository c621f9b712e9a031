from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.things import ball, box, thing  # noqa: E402

from thinkgrasp.perception.color import lab_from_rgb, name_colors  # noqa: E402
from thinkgrasp.sim.objects import Texture, VisualPiece  # noqa: E402
from thinkgrasp.sim.render import BACKGROUND, Rendering, render  # noqa: E402
from thinkgrasp.sim.shadows import reached_by  # noqa: E402
from thinkgrasp.sim.tabletop import pose  # noqa: E402
from thinkgrasp.sim.textures import LINEAR_FROM_SRGB, sample  # noqa: E402
from thinkgrasp.sim.views import CameraView, camera, default_view, look_at  # noqa: E402
from thinkgrasp.sim.world import World  # noqa: E402

FIELDS = ("color", "depth", "geoms", "normals")
DOWN = CameraView(camera("l515", (224, 224)), look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), up=(1, 0, 0)))


def world_with(*placed: tuple[object, np.ndarray]) -> World:
    world = World([thing for thing, _ in placed], robot=False)
    for index, (_, T) in enumerate(placed):
        world.place(index, T)
    mujoco.mj_forward(world.model, world.data)
    return world


def picture(world: World, view: CameraView, **settings) -> Rendering:
    return render(world.model, world.data, view, world.visuals, **settings)


@pytest.fixture(scope="module")
def pair() -> World:
    return world_with(
        (ball(0.04, (0.75, 0.08, 0.08)), pose(0.45, -0.06, 0.04)),
        (box((0.08, 0.06, 0.12), (0.1, 0.3, 0.75)), pose(0.55, 0.07, 0.06, 0.4)),
    )


def test_depth_is_along_the_optical_axis(pair):
    seen = picture(pair, DOWN)
    table = seen.geoms == pair.model.geom("table").id
    assert table.mean() > 0.8
    assert seen.depth[table] == pytest.approx(0.8, abs=1e-6)  # a plane across the axis has one depth
    top = seen.geoms == pair.model.geom("object_1_visual_0").id
    assert top.any()
    assert seen.depth[top].min() == pytest.approx(0.68, abs=1e-6)
    assert np.abs(seen.normals[top & (seen.depth < 0.6801)] - [0, 0, 1]).max() < 1e-6


def test_nothing_hit_has_no_depth_no_geom_and_the_background():
    world = world_with((ball(0.04, (1, 0, 0)), pose(0.5, 0, 0.04)))
    up = CameraView(camera("l515", (224, 224)), look_at((0.5, 0, 0.5), (0.5, 0, 2.0), up=(1, 0, 0)))
    seen = picture(world, up)
    assert (seen.depth == 0).all()
    assert (seen.geoms == -1).all()
    assert (seen.color == np.round(np.array(BACKGROUND) * 255)).all()


def test_collision_shapes_are_not_seen(pair):
    seen = picture(pair, default_view())
    groups = pair.model.geom_group[np.unique(seen.geoms[seen.geoms >= 0])]
    assert set(groups.tolist()) <= {0, 1, 2}


def test_threads_do_not_change_a_bit(pair):
    view = default_view()
    one, three = picture(pair, view, threads=1), picture(pair, view, threads=3)
    for field in FIELDS:
        assert np.array_equal(getattr(one, field), getattr(three, field)), field


DIGEST = """
import hashlib, sys
sys.path.insert(0, "tests")
from sim.test_render import DOWN, ball, picture, pose, world_with
seen = picture(world_with((ball(0.04, (0.7, 0.1, 0.1)), pose(0.5, 0, 0.04))), DOWN)
print(hashlib.sha256(seen.color.tobytes() + seen.depth.tobytes() + seen.geoms.tobytes()).hexdigest())
"""


def test_processes_do_not_change_a_bit(request):
    runs = {
        subprocess.run(
            [sys.executable, "-c", DIGEST], cwd=request.config.rootpath, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    }
    assert len(runs) == 1


def test_shadows_darken_the_table_beside_things_and_nothing_else(pair):
    view = default_view()
    lit, shaded = picture(pair, view, shadows=False), picture(pair, view)
    assert np.array_equal(lit.depth, shaded.depth)
    darker = shaded.color.astype(int).sum(axis=2) - lit.color.astype(int).sum(axis=2)
    assert darker.max() == 0
    table = lit.geoms == pair.model.geom("table").id
    assert 0.005 < (darker[table] < -30).mean() < 0.2


@pytest.mark.parametrize("lamp", [(1.15, -0.75, 1.45), (0.3, 0.2, 0.5), (2.5, 0.0, 0.1)])
def test_shadows_are_those_of_a_ray_to_every_point(lamp):
    world = World([ball(0.04, (1, 0, 0)), box((0.08, 0.06, 0.12), (0, 0, 1))])  # with the arm
    world.place(0, pose(0.45, -0.06, 0.04))
    world.place(1, pose(0.55, 0.07, 0.06, 0.4))
    mujoco.mj_forward(world.model, world.data)
    view = default_view("l515", (320, 240))
    seen = picture(world, view, shadows=False)
    hit = seen.depth.ravel() > 0
    points = view.eye + seen.depth.ravel()[hit, None].astype(float) * view.rays[hit]
    everything = np.ones(len(points), bool)
    few, every = (
        reached_by(np.array(lamp), world.model, world.data, points, everything, cull=cull) for cull in (True, False)
    )
    assert 0.005 < (every == 0).mean() < 0.9
    assert np.array_equal(few, every)


@pytest.mark.parametrize(
    ("name", "srgb"),
    [
        ("red", (0.75, 0.08, 0.08)),
        ("green", (0.10, 0.50, 0.16)),
        ("blue", (0.10, 0.25, 0.75)),
        ("yellow", (0.93, 0.80, 0.10)),
        ("orange", (0.93, 0.45, 0.08)),
        ("white", (0.92, 0.92, 0.90)),
        ("black", (0.05, 0.05, 0.06)),
    ],
)
def test_colours_keep_their_name_in_light_and_shade(name, srgb):
    world = world_with(
        (ball(0.04, srgb), pose(0.45, -0.06, 0.04)), (box((0.06, 0.06, 0.10), srgb), pose(0.6, 0.1, 0.05, 0.5))
    )
    seen = picture(world, default_view())
    for index in range(2):
        pixels = seen.color[world.object_of_geom[seen.geoms] == index]
        assert name_colors(lab_from_rgb(pixels))[0][0] == name


def test_nothing_is_overexposed(pair):
    white = world_with((box((0.2, 0.2, 0.02), (0.95, 0.95, 0.95)), pose(0.5, 0.0, 0.01)))
    seen = picture(white, default_view())
    assert (seen.color.min(axis=2) >= 254).mean() < 0.005
    table = picture(pair, default_view()).color[200:400]
    assert 90 < np.median(table) < 200


LETTER = np.zeros((40, 40, 3), np.uint8)
LETTER[:20, :20] = (255, 0, 0)  # red top left, green top right, blue bottom left
LETTER[:20, 20:] = (0, 255, 0)
LETTER[20:, :20] = (0, 0, 255)
CUBE = np.array([[-0.05] * 3, [0.05] * 3])


@pytest.mark.parametrize(
    ("eye", "up"),
    [
        ((1, 0, 0), (0, 0, 1)),
        ((-1, 0, 0), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1)),
        ((0, -1, 0), (0, 0, 1)),
        ((0, 0, 1), (0, 1, 0)),
        ((0, 0, -1), (0, 1, 0)),
    ],
)
def test_every_side_of_a_box_reads_from_outside(eye, up):
    view = CameraView(camera("l515", (224, 224)), look_at(eye, (0, 0, 0), up=up))
    texture = Texture(LETTER, "box", CUBE)
    R = view.T_world_camera[:3, :3]
    for (right, down), rgb in {(-1, -1): (1, 0, 0), (1, -1): (0, 1, 0), (-1, 1): (0, 0, 1), (1, 1): (0, 0, 0)}.items():
        point = 0.05 * np.array(eye) + R @ (0.02 * np.array([right, down, 0.0]))
        got = sample(texture, point[None].astype(np.float32), np.array([eye], np.float32), 1e-4)
        assert got[0] == pytest.approx(rgb)


def test_a_cylinder_is_wrapped_counter_clockwise_from_minus_y():
    ramp = np.broadcast_to(np.arange(200, dtype=np.uint8)[None, :, None], (10, 200, 3)).copy()
    texture = Texture(ramp, "cylinder", CUBE)
    angle = np.array([0.1, 0.25, 0.5, 0.75, 0.9]) * 2 * np.pi
    points = 0.05 * np.stack([np.sin(angle), -np.cos(angle), 0 * angle], axis=1).astype(np.float32)
    got = sample(texture, points, points, 1e-4)[:, 0]
    assert got == pytest.approx(LINEAR_FROM_SRGB[np.array([20, 50, 100, 150, 180])], rel=0.1)


def test_a_ball_has_latitude_from_the_top():
    rows = np.broadcast_to(np.arange(0, 180, dtype=np.uint8)[:, None, None], (180, 360, 3)).copy()
    texture = Texture(rows, "sphere", CUBE)
    points = 0.05 * np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1]], np.float32)
    assert sample(texture, points, points, 1e-5)[:, 0] == pytest.approx(LINEAR_FROM_SRGB[[0, 90, 179]], rel=0.05)


def test_fine_detail_is_averaged_at_a_distance():
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    points = np.column_stack([np.linspace(-0.04, 0.04, 50), np.full(50, -0.05), np.zeros(50)]).astype(np.float32)
    normals = np.broadcast_to(np.array([0, -1, 0], np.float32), (50, 3))
    far = sample(Texture(stripes, "box", CUBE), points, normals, 0.02)
    assert far == pytest.approx(np.full((50, 3), 0.5), abs=0.01)


def test_a_texture_turns_with_its_object():
    mesh = box((0.1, 0.1, 0.1), (1, 1, 1)).visuals[0]
    textured = VisualPiece("body", mesh.vertices, mesh.faces, (1, 1, 1), Texture(LETTER, "box", CUBE), 0.0)
    obj = thing("cube", (textured,), *box((0.1, 0.1, 0.1), (1, 1, 1)).collisions)
    colors = []
    for yaw in (0.0, np.pi / 2):
        seen = picture(world_with((obj, pose(0.5, 0.0, 0.05, yaw))), DOWN, shadows=False)
        rows, columns = np.nonzero(np.abs(seen.depth - 0.7) < 1e-4)
        quarter = (rows < rows.mean()) & (columns < columns.mean())  # the world's +x, +y
        colors.append(np.median(seen.color[rows[quarter], columns[quarter]], axis=0))
    assert colors[0][1] > 200  # the texture's top right is green
    assert colors[0][[0, 2]].max() < 60
    assert colors[1].max() < 60  # a quarter turn brings its bottom right there, which is black


def test_plain_pieces_take_their_colour_from_the_visuals_not_the_model(pair):
    pair.model.geom("object_0_visual_0").rgba[:3] = (0, 1, 0)
    seen = picture(pair, default_view())
    pixels = seen.color[pair.object_of_geom[seen.geoms] == 0].astype(int)
    assert (pixels[:, 0] > pixels[:, 1]).all()
