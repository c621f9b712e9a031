from __future__ import annotations

import itertools

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import apply, deproject, invert
from thinkgrasp.sim.views import SIZES, CameraView, camera, default_view, look_at


@pytest.mark.parametrize(("model", "vertical_deg"), [("l515", 55.0), ("d455", 58.0)])
@pytest.mark.parametrize("size", SIZES)
def test_the_vertical_field_of_view_is_the_published_one(model, vertical_deg, size):
    c = camera(model, size)
    assert np.degrees(2 * np.arctan(c.height / 2 / c.fy)) == pytest.approx(vertical_deg)
    assert (c.cx, c.cy) == ((c.width - 1) / 2, (c.height - 1) / 2)


def test_four_by_three_images_fit_into_the_published_horizontal_field_of_view():
    for model, horizontal_deg in (("l515", 70.0), ("d455", 87.0)):
        c = camera(model, (640, 480))
        assert np.degrees(2 * np.arctan(c.width / 2 / c.fx)) < horizontal_deg


def test_the_square_image_is_the_middle_of_the_full_one():
    full, square = camera("l515", (640, 480)), camera("l515", (224, 224))
    point = np.array([0.11, -0.07, 0.6])
    u, v = full.project(point) - (full.cx, full.cy)
    assert square.project(point) - (square.cx, square.cy) == pytest.approx(np.array([u, v]) * 224 / 480)


@pytest.mark.parametrize(
    ("model", "size", "words"), [("zed", (640, 480), "d455, l515"), ("l515", (100, 100), "640x480, 320x240, 224x224")]
)
def test_unknown_cameras_are_refused_with_what_is_allowed(model, size, words):
    with pytest.raises(ConfigError, match=words):
        camera(model, size)


def test_look_at_puts_the_target_in_the_middle_and_up_is_up():
    T = look_at((0.86, 0.1, 0.55), (0.5, 0.0, 0.02))
    target = apply(invert(T), np.array([0.5, 0.0, 0.02]))
    assert target == pytest.approx([0, 0, np.linalg.norm([0.36, 0.1, 0.53])], abs=1e-12)
    assert T[2, 1] < 0  # the image's y axis points down in the world
    assert T[2, 0] == pytest.approx(0)  # level


def test_a_camera_that_looks_straight_down_needs_another_up():
    with pytest.raises(InputError, match="line of sight"):
        look_at((0, 0, 1), (0, 0, 0))
    assert look_at((0, 0, 1), (0, 0, 0), up=(1, 0, 0))[:3, 2] == pytest.approx([0, 0, -1])
    with pytest.raises(InputError, match="coincide"):
        look_at((0, 0, 1), (0, 0, 1))


def test_rays_are_the_inverse_of_projection():
    view = default_view("l515", (320, 240))
    depth = np.full((240, 320), 0.7, np.float32)
    points = apply(view.T_world_camera, deproject(depth, view.intrinsics).astype(np.float64)).reshape(-1, 3)
    assert view.eye + np.float64(depth[0, 0]) * view.rays == pytest.approx(points, abs=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_the_default_view_holds_the_workspace_and_what_stands_in_it(size):
    view = default_view("l515", size)
    height = 0.2 if size != (224, 224) else 0.05
    corners = np.array(list(itertools.product((0.276, 0.724), (-0.224, 0.224), (0.0, height))))
    uv = view.intrinsics.project(apply(invert(view.T_world_camera), corners))
    assert (uv > 0).all()
    assert (uv < (size[0] - 1, size[1] - 1)).all()
    assert (np.ptp(uv[corners[:, 2] == 0], axis=0) > 0.5 * np.array(size)).all()  # and fills it


def test_a_view_needs_a_rigid_pose():
    with pytest.raises(InputError, match="rigid"):
        CameraView(camera("l515"), np.diag([2.0, 1, 1, 1]))
