"""The analytic renderer: depth against closed forms, labels, occlusion, noise, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, deproject, make_transform
from thinkgrasp.sim import tabletop as tt
from thinkgrasp.sim.solids import Bowl, Box, Cup, Cylinder, Ellipsoid, Paint, Tube
from thinkgrasp.types import CameraIntrinsics

GREY = Paint((120, 120, 120))
CAMERA = CameraIntrinsics(161, 121, 150.0, 150.0, 80.0, 60.0)
EYE_M = 0.8
DOWN = tt.look_at((0.0, 0.0, EYE_M), (0.0, 0.0, 0.0))


def scene_of(*solids: object) -> tt.TabletopScene:
    return tt.TabletopScene(tuple(tt.TableObject(f"thing {i}", (s,), np.eye(4)) for i, s in enumerate(solids)))


def center_depth(*solids: object) -> float:
    return float(tt.render(scene_of(*solids), CAMERA, DOWN, noise=False).frame.depth[60, 80])


def points_of(solid: object, T_world_camera: np.ndarray) -> np.ndarray:
    r = tt.render(scene_of(solid), CAMERA, T_world_camera, noise=False)
    return apply(T_world_camera, deproject(r.frame.depth, CAMERA)[r.mask(0)].astype(np.float64))


@pytest.mark.parametrize(
    ("solid", "height_m"),
    [
        (Box((0.1, 0.1, 0.06), GREY, tt.pose(0, 0, 0.03)), 0.06),
        (Cylinder(0.04, 0.1, GREY, tt.pose(0, 0, 0.05)), 0.1),
        (Cylinder(0.04, 0.1, GREY, tt.pose(0, 0, 0.05), top_radius_m=0.02), 0.1),
        (Ellipsoid((0.05, 0.03, 0.02), GREY, tt.pose(0, 0, 0.02)), 0.04),
        (Cup(0.04, 0.09, GREY, wall_m=0.005), 0.005),
        (Bowl(0.08, 0.05, GREY, wall_m=0.006), 0.006),
        (Tube(np.array([[-0.05, 0, 0.02], [0.05, 0, 0.02]]), (0.02, 0.02), GREY), 0.04),
    ],
)
def test_depth_above_the_centre_is_exact(solid: object, height_m: float) -> None:
    assert center_depth(solid) == pytest.approx(EYE_M - height_m, abs=1e-6)


def test_empty_table_is_the_plane_seen_obliquely() -> None:
    T = tt.look_at((0.1, -0.5, 0.6), (0.0, 0.0, 0.0))
    r = tt.render(scene_of(), CAMERA, T, noise=False)
    world = apply(T, deproject(r.frame.depth, CAMERA).astype(np.float64))
    on_table = (np.abs(world[..., 0]) < 0.59) & (np.abs(world[..., 1]) < 0.39)
    assert on_table.mean() > 0.5
    np.testing.assert_allclose(world[on_table][:, 2], 0.0, atol=1e-6)
    assert (r.labels == -1).all()


def test_floor_lies_below_the_table_edge() -> None:
    r = tt.render(scene_of(), CAMERA, tt.look_at((0.6, 0.0, EYE_M), (0.6, 0.0, 0.0)), noise=False)
    assert r.frame.depth[60, 40] != pytest.approx(r.frame.depth[60, 120])
    assert sorted(np.unique(np.round(r.frame.depth[60, [20, 140]], 5))) == [np.float32(0.8), np.float32(1.55)]


def test_oblique_hits_satisfy_the_surface_equations() -> None:
    T = tt.look_at((0.35, -0.4, 0.45), (0.0, 0.0, 0.03))
    sphere = points_of(Ellipsoid((0.05,) * 3, GREY, tt.pose(0, 0, 0.05)), T)
    np.testing.assert_allclose(np.linalg.norm(sphere - [0, 0, 0.05], axis=1), 0.05, atol=1e-6)

    cup = points_of(Cup(0.04, 0.08, GREY, wall_m=0.004), T)
    radius, z = np.linalg.norm(cup[:, :2], axis=1), cup[:, 2]
    surfaces = np.stack([np.abs(radius - 0.04), np.abs(radius - 0.036), np.abs(z - 0.08), np.abs(z - 0.004)])
    assert surfaces.min(axis=0).max() < 1e-6
    assert (np.argmin(surfaces, axis=0) == 1).sum() > 50, "the inner wall is seen"

    frustum = points_of(Cylinder(0.05, 0.1, GREY, tt.pose(0, 0, 0.05), top_radius_m=0.03), T)
    side = np.abs(np.linalg.norm(frustum[:, :2], axis=1) - (0.05 - 0.2 * frustum[:, 2]))
    assert np.minimum(side, np.abs(frustum[:, 2] - 0.1)).max() < 1e-6

    bowl = points_of(Bowl(0.08, 0.05, GREY, wall_m=0.006), T)
    shell = np.linalg.norm(bowl - [0, 0, 0.08], axis=1)
    distance = np.stack([np.abs(shell - 0.08), np.abs(shell - 0.074), np.abs(bowl[:, 2] - 0.05)])
    assert distance.min(axis=0).max() < 1e-6
    assert set(np.argmin(distance, axis=0)) == {0, 1, 2}


def test_poses_of_object_and_solid_compose() -> None:
    T_object_solid = tt.pose(0.0, 0.0, 0.03, 0.7)
    thing = tt.TableObject("brick", (Box((0.12, 0.04, 0.06), GREY, T_object_solid),), tt.pose(0.05, -0.04, 0.0, 0.4))
    r = tt.render(tt.TabletopScene((thing,)), CAMERA, DOWN, noise=False)
    world = apply(DOWN, deproject(r.frame.depth, CAMERA)[r.mask(0)].astype(np.float64))
    local = apply(np.linalg.inv(thing.T_world_object @ T_object_solid), world)
    top = local[np.abs(local[:, 2] - 0.03) < 1e-6]
    assert len(top) > 0.8 * len(local)
    assert np.ptp(top[:, 0]) == pytest.approx(0.12, abs=0.01)
    assert np.ptp(top[:, 1]) == pytest.approx(0.04, abs=0.01)


def test_labels_and_visible_fractions_tell_who_hides_whom() -> None:
    under = Box((0.10, 0.10, 0.02), GREY, tt.pose(0, 0, 0.01))
    lid = Box((0.05, 0.10, 0.02), Paint((200, 20, 20)), tt.pose(-0.025, 0, 0.0300001))
    away = Box((0.02, 0.02, 0.02), GREY, tt.pose(5, 0, 0.01))
    r = tt.render(scene_of(under, lid, away), CAMERA, DOWN, noise=False)
    assert r.labels[60, 75] == 1
    assert r.labels[60, 85] == 0
    assert r.labels[5, 5] == -1
    assert r.visible_fraction[1:] == (1.0, 0.0)
    alone = tt.render(scene_of(under), CAMERA, DOWN, noise=False).mask(0).sum()
    assert r.visible_fraction[0] == pytest.approx((r.labels == 0).sum() / alone)
    assert 0.4 < r.visible_fraction[0] < 0.5


def test_shadow_darkens_the_table_away_from_the_light() -> None:
    r = tt.render(scene_of(Box((0.04, 0.04, 0.12), GREY, tt.pose(0, 0, 0.06))), CAMERA, DOWN, noise=False)
    toward, opposite = (tt.LIGHTS[0][:2] * sign * 0.12 for sign in (1, -1))
    scale = CAMERA.fx / EYE_M
    lit = r.frame.color[round(60 - toward[1] * scale), round(80 + toward[0] * scale)].astype(int)
    dark = r.frame.color[round(60 - opposite[1] * scale), round(80 + opposite[0] * scale)].astype(int)
    assert (lit - dark).min() > 25


def test_noise_grows_with_distance_and_depth_is_in_millimetres() -> None:
    def spread(height: float) -> float:
        T = tt.look_at((0.0, 0.0, height), (0.0, 0.0, 0.0))
        depth = tt.render(scene_of(), CAMERA, T, rng=np.random.default_rng(1)).frame.depth.astype(np.float64)
        np.testing.assert_allclose(depth * 1e3, np.round(depth * 1e3), atol=1e-4)
        return float(np.std(depth[40:80, 60:100] - height))

    near, far = spread(0.7), spread(1.4)
    assert 2.5 < far / near < 4.5
    assert 0.0015 < far < 0.0035


def test_dropout_takes_the_share_asked_for() -> None:
    full = tt.render(scene_of(), CAMERA, DOWN, noise=False)
    holes = tt.render(scene_of(), CAMERA, DOWN, noise=False, dropout=0.2)
    assert (full.frame.depth == 0).mean() == 0
    assert (holes.frame.depth == 0).mean() == pytest.approx(0.2, abs=0.01)
    with pytest.raises(InputError, match="dropout"):
        tt.render(scene_of(), CAMERA, DOWN, dropout=1.5)


def test_demo_scene_is_deterministic_and_differs_by_seed() -> None:
    camera, T = tt.demo_camera()
    small = CameraIntrinsics(160, 120, camera.fx / 4, camera.fy / 4, 79.5, 59.5)
    a, b = (tt.render(tt.demo_scene(3), small, T, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a.frame.color, b.frame.color)
    np.testing.assert_array_equal(a.frame.depth, b.frame.depth)
    np.testing.assert_array_equal(a.labels, b.labels)
    other = tt.render(tt.demo_scene(4), small, T, rng=np.random.default_rng(5))
    assert (other.labels != a.labels).any()


@pytest.mark.parametrize("seed", range(4))
def test_every_demo_object_is_well_in_view(seed: int) -> None:
    camera, T = tt.demo_camera()
    scene = tt.demo_scene(seed)
    r = tt.render(scene, camera, T, noise=False)
    assert len(scene.objects) == 10
    assert min(r.visible_fraction) > 0.5
    assert min(r.mask(i).sum() for i in range(10)) > 400
    assert not np.isin(r.labels[[0, -1]], range(10)).any()
    assert not np.isin(r.labels[:, [0, -1]], range(10)).any()


def test_solids_refuse_sizes_that_cannot_be() -> None:
    with pytest.raises(InputError, match="height_m must be positive"):
        Cylinder(0.02, 0.0, GREY)
    with pytest.raises(InputError, match="no room"):
        Cup(0.02, 0.1, GREY, wall_m=0.03)
    with pytest.raises(InputError, match="bowl height"):
        Bowl(0.05, 0.2, GREY)
    with pytest.raises(InputError, match="coincide"):
        tt.look_at((0, 0, 1), (0, 0, 1))


def test_look_at_gives_a_level_optical_frame() -> None:
    T = tt.look_at((0.3, -0.5, 0.6), (0.0, 0.1, 0.0))
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[2, 0] == pytest.approx(0.0), "x is level"
    assert T[2, 1] < 0, "y points down"
    assert make_transform(T[:3, :3], T[:3, 3]).shape == (4, 4)
