"""Several views as one: what is added lies where things are, what disagrees is named, and collisions are with all."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fakes.stages import fake_pipeline
from fakes.tables import BLUE, RED, WHITE, view
from scipy.spatial.transform import Rotation

from thinkgrasp import make_pipeline
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.checks.collision import CollisionCheck
from thinkgrasp.checks.force_closure import ForceClosureCheck
from thinkgrasp.checks.model_free import ModelFreeCollisionCheck
from thinkgrasp.errors import ConfigError, ContractError, InputError
from thinkgrasp.fusion import MAX_VIEWS, agreeing_views, describe, fuse, seen_free
from thinkgrasp.geometry import apply, deproject, invert, make_transform
from thinkgrasp.gripper import Gripper
from thinkgrasp.robots.simulated import perceived_cloud
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Frame, Grasps, OtherViews, Scene, Segment

GRIPPER = Gripper.load("robotiq_2f85")
SIZE = (320, 240)
BOX_M, BOX_AT = (0.10, 0.06, 0.12), (0.02, 0.03)
HIDDEN_M, HIDDEN_AT = (0.04, 0.04, 0.05), (0.02, 0.13)
FRONT, BACK, SIDE = (0.0, -0.5, 0.45), (0.05, 0.62, 0.45), (0.55, 0.05, 0.4)


@cache
def shot(eye: tuple[float, float, float], *, noise: bool = False, hidden: bool = True) -> Frame:
    """A box on a table, and a low one that the front camera cannot see for it."""
    things = [t.box("box", BOX_M, RED, t.pose(*BOX_AT))]
    if hidden:
        things.append(t.box("hidden", HIDDEN_M, BLUE, t.pose(*HIDDEN_AT)))
    return view(*things, eye=eye, size=SIZE, noise=noise).frame


def moved(frame: Frame, shift_m: tuple[float, float, float], turn_deg: float = 0.0) -> Frame:
    """The frame with its pose off by so much, in the world; turned about a vertical through its camera."""
    assert frame.T_world_camera is not None
    T = frame.T_world_camera.copy()
    T[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix() @ T[:3, :3]
    T[:3, 3] += shift_m
    return replace(frame, T_world_camera=T)


def added(frame: Frame) -> np.ndarray:
    """What fusion added, in the world."""
    assert frame.others is not None
    assert frame.T_world_camera is not None
    return apply(frame.T_world_camera, frame.others.points.astype(np.float64))


def off_surface(world: np.ndarray) -> np.ndarray:
    """Distance (N,) of points from the nearest of the table, its edge and floor included, and the two boxes."""
    away = [np.abs(world[:, 2]), np.abs(world[:, 2] + 0.75)]
    for size, at in ((BOX_M, BOX_AT), (HIDDEN_M, HIDDEN_AT), ((1.2, 0.8, 0.04), (0.0, 0.0, -0.04))):
        low_z = at[2] if len(at) == 3 else 0.0
        centre = np.array([at[0], at[1], low_z + size[2] / 2])
        q = np.abs(world - centre) - np.array(size) / 2
        away.append(np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)))
    return np.min(away, axis=0)


def scene_of(frame: Frame) -> Scene:
    return Scene(frame, deproject(frame.depth, frame.camera))


def test_what_is_added_lies_on_the_things_and_was_not_seen_by_the_first():
    fused = fuse([shot(FRONT), shot(BACK)])
    world = added(fused)
    assert off_surface(world).max() < 0.002
    box = (np.abs(world[:, :2] - BOX_AT) <= np.array(BOX_M[:2]) / 2 + 0.001).all(axis=1) & (world[:, 2] > 0.01)
    assert np.allclose(world[box, 1], BOX_AT[1] + BOX_M[1] / 2, atol=0.002), "only the back of the box is new"
    hidden = (np.abs(world[:, :2] - HIDDEN_AT) <= 0.021).all(axis=1) & (world[:, 2] > 0.01)
    assert hidden.sum() > 100
    assert fused.others is not None
    assert (fused.others.agrees, fused.others.degraded) == ((True,), ())
    assert fused.others.disagreement_m[0] < 2e-4


@pytest.mark.parametrize("seed", [0, 1])
def test_fusion_does_not_depend_on_the_world_frame(seed):
    """Whatever the world's origin and axes: the same points, in the first camera's frame."""
    frames = [shot(FRONT), shot(BACK)]
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    T = make_transform(R, np.array([1.0, -2.0, 0.5]))
    here = fuse(frames).others
    there = fuse([replace(f, T_world_camera=T @ f.T_world_camera) for f in frames]).others
    assert here is not None
    assert there is not None
    assert len(here.points) == pytest.approx(len(there.points), rel=0.01)
    assert here.disagreement_m == pytest.approx(there.disagreement_m, abs=1e-4)


def test_the_first_view_stays_as_it_is():
    first = shot(FRONT)
    fused = fuse([first, shot(BACK)])
    assert fused.depth is first.depth
    assert fused.color is first.color
    assert fuse([first]) is first
    assert describe(first) == "one view"
    assert describe(fused).startswith("2 views fused: ")
    same = fuse([first, first])
    assert same.others is not None
    assert len(same.others.points) < 0.002 * first.depth.size, "a second look from the same place adds nothing"


def test_what_an_earlier_view_added_is_not_added_again():
    once, thrice = (fuse([shot(FRONT), *[shot(BACK)] * n]).others for n in (1, 3))
    assert once is not None
    assert thrice is not None
    assert len(thrice.points) == len(once.points)
    assert thrice.agrees == (True,) * 3
    wrong = moved(shot(BACK), (0, 0, 0.02))
    after = fuse([shot(FRONT), wrong, shot(BACK)]).others
    assert after is not None
    assert (after.view == 1).sum() == len(once.points), "what disagrees keeps nothing away that may be grasped"


def test_the_added_points_know_their_view_colour_and_normal():
    fused = fuse([shot(FRONT), shot(BACK), shot(SIDE)])
    others = fused.others
    assert others is not None
    assert set(others.view.tolist()) == {0, 1}
    assert fused.T_world_camera is not None
    world = added(fused)
    back = (others.view == 0) & (np.abs(world[:, 1] - 0.06) < 1e-3) & (np.abs(world[:, 0] - 0.02) < 0.04)
    back &= (world[:, 2] > 0.02) & (world[:, 2] < 0.10)
    assert back.sum() > 50
    normals = others.normals[back] @ fused.T_world_camera[:3, :3].T
    assert np.allclose(np.nanmedian(normals, axis=0), [0, 1, 0], atol=0.05), "out of the back, not into it"
    red = others.colors[back].astype(int)
    assert (red[:, 0] > red[:, 1] + 30).mean() > 0.95


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("shift", [(0.012, 0, 0), (0, 0.012, 0), (0, 0, 0.012), (-0.008, 0.008, 0.004)])
def test_a_wrong_pose_is_measured_and_named(shift, noise):
    frames = [
        view(t.box("box", BOX_M, RED, t.pose(0, 0, yaw=0.8)), eye=eye, size=SIZE, noise=noise).frame
        for eye in ((-0.1, -0.5, 0.45), (0.1, -0.5, 0.4))
    ]
    fused = fuse([frames[0], moved(frames[1], shift)])
    assert fused.others is not None
    worst = max(abs(s) for s in shift)
    assert 0.7 * worst < fused.others.disagreement_m[0] < 1.3 * float(np.linalg.norm(shift))
    assert fused.others.agrees == (False,)
    (said,) = fused.others.degraded
    assert said.stage == "fusion"
    assert "mm apart (limit 5 mm)" in said.reason
    assert [frame for frame, _ in agreeing_views(fused)] == [fused]


def turned(frame: Frame, axis: str, deg: float) -> Frame:
    """The frame with its pose turned about an axis of the world through the middle of the table."""
    assert frame.T_world_camera is not None
    R = Rotation.from_euler(axis, deg, degrees=True).as_matrix()
    return replace(frame, T_world_camera=make_transform(R, np.zeros(3)) @ frame.T_world_camera)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("noise", [False, True])
def test_a_view_that_is_turned_lies_too_high_in_one_place_and_too_low_in_another(axis, noise):
    """The table is 1 cm off at 0.3 m, and not at all on average."""
    near, far = (
        view(t.box("box", BOX_M, RED, t.pose(*BOX_AT)), eye=eye, size=SIZE, noise=noise).frame
        for eye in ((-0.1, -0.6, 0.5), (0.1, -0.6, 0.55))
    )
    right, wrong = (fuse([near, f]).others for f in (far, turned(far, axis, 2.0)))
    assert right is not None
    assert wrong is not None
    assert (right.agrees, wrong.agrees) == ((True,), (False,))
    assert right.disagreement_m[0] < 0.002
    assert 0.005 < wrong.disagreement_m[0] < 0.02
    assert "mm apart" in wrong.degraded[0].reason


def test_views_with_noise_agree():
    others = fuse([shot(FRONT, noise=True), shot(BACK, noise=True), shot(SIDE, noise=True)]).others
    assert others is not None
    assert max(others.disagreement_m) < 0.002
    assert all(others.agrees)


def test_a_thing_that_moved_between_two_looks_is_named():
    big = t.box("box", (0.3, 0.2, 0.25), RED, t.pose(0.1, 0.15))
    there = view(big, eye=SIDE, size=SIZE, noise=False).frame
    gone = view(eye=FRONT, size=SIZE, noise=False).frame
    others = fuse([gone, there]).others
    assert others is not None
    assert others.agrees == (False,)
    assert "stands where the first camera saw free space" in others.degraded[0].reason
    assert (apply(gone.T_world_camera, others.points.astype(float))[:, 2] > 0.2).any(), "what may be glass stays"


def test_views_that_share_nothing_cannot_be_checked():
    aside = view(eye=(5.0, 5.0, 0.5), target=(8.0, 8.0, -0.7), size=SIZE, noise=False).frame
    others = fuse([shot(FRONT), aside]).others
    assert others is not None
    assert math.isnan(others.disagreement_m[0])
    assert "cannot be checked" in others.degraded[0].reason


def test_mixed_pixels_in_free_space_are_left_out():
    frame = shot(SIDE)
    depth = frame.depth.copy()
    rng = np.random.default_rng(0)
    v, u = rng.integers(20, 220, 300), rng.integers(20, 300, 300)
    depth[v, u] *= rng.uniform(0.5, 0.9, 300).astype(np.float32)
    clean, noisy = (added(fuse([shot(FRONT), f])) for f in (frame, replace(frame, depth=depth)))
    assert off_surface(clean).max() < 0.002
    assert (off_surface(noisy) > 0.01).sum() < 5


def grasp_behind(y: float = HIDDEN_AT[1]) -> tuple[np.ndarray, np.ndarray]:
    """Straight down over the low box, its fingers to either side in y; one of them in the big box's back or not."""
    R = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return R, np.array([HIDDEN_AT[0], y, 0.03])


def grasps_in(frame: Frame, R: np.ndarray, p: np.ndarray, width: float = 0.06) -> Grasps:
    assert frame.T_world_camera is not None
    T = invert(frame.T_world_camera) @ make_transform(R, p)
    f = np.float32
    return Grasps(T[None, :3, :3].astype(f), T[None, :3, 3].astype(f), np.array([width], f), np.ones(1, f))


def whole(frame: Frame) -> Segment:
    h, w = frame.depth.shape
    return Segment("x", 1.0, np.ones((h, w), bool), (0, 0, w, h), False)


@pytest.mark.parametrize("check", [CollisionCheck(standoff_m=0.0), ModelFreeCollisionCheck(voxel_m=0.005)])
def test_a_collision_that_only_the_second_view_sees_is_found(check):
    alone, fused = shot(FRONT), fuse([shot(FRONT), shot(BACK)])
    into = grasps_in(alone, *grasp_behind(HIDDEN_AT[1] + 0.03))  # a finger in the middle of the low box
    for frame, free in ((alone, True), (fused, False)):
        assert check.keep(scene_of(frame), whole(frame), into, GRIPPER)[0] == free


def test_something_between_the_fingers_that_only_the_second_view_sees_counts():
    alone, fused = shot(FRONT), fuse([shot(FRONT), shot(BACK)])
    around = grasps_in(alone, *grasp_behind())
    for frame, held in ((alone, False), (fused, True)):
        assert ForceClosureCheck().keep(scene_of(frame), whole(frame), around, GRIPPER)[0] == held
    assert CollisionCheck(standoff_m=0.0).keep(scene_of(fused), whole(fused), around, GRIPPER)[0]


def test_the_noise_of_a_support_that_only_the_second_view_sees_does_not_count():
    scene = make_pipeline("offline")._perceive(fuse([shot(FRONT, noise=True), shot(BACK, noise=True)]))
    assert scene.support is not None
    others = scene.frame.others
    assert others is not None
    height = scene.support.height(others.points)
    assert (np.abs(height) < 0.003).sum() > 200, "the table behind the boxes"
    counted = CollisionCheck(support_noise_m=0.003)._counted(scene)
    own = np.count_nonzero(np.isfinite(scene.points[..., 2]))
    assert len(counted) <= own + np.count_nonzero(height > 0.003)
    assert len(CollisionCheck()._counted(scene)) == own + len(height)


def test_motions_are_planned_against_all_views():
    fused = fuse([shot(FRONT), shot(BACK)])
    assert len(perceived_cloud(fused)) == len(perceived_cloud(shot(FRONT))) + len(added(fused))


def test_seen_free():
    fused = fuse([shot(FRONT), shot(BACK)])
    assert fused.T_world_camera is not None
    world = np.array([[0.02, 0.09, 0.09], [0.02, 0.03, 0.06], [0.02, 0.13, 0.02], [0.1, 0.2, 0.1]])
    points = apply(invert(fused.T_world_camera), world)
    assert seen_free(fused, points).tolist() == [True, False, False, True]
    assert not seen_free(shot(FRONT), points).any()


def test_a_decision_says_where_the_views_disagree():
    good = fake_pipeline().decide(fuse([shot(FRONT), shot(BACK)]), "the red block")
    bad = fake_pipeline().decide(fuse([shot(FRONT), moved(shot(BACK), (0, 0, 0.02))]), "the red block")
    assert [d.stage for d in good.degraded] == []
    assert [d.stage for d in bad.degraded] == ["fusion"]


def bad_inputs() -> dict[str, tuple[list[Frame], dict[str, object], str]]:
    first, second = shot(FRONT), shot(BACK)
    fused = fuse([first, second])
    return {
        "none": ([], {}, f"1 to {MAX_VIEWS} frames, got 0"),
        "too many": ([first] * (MAX_VIEWS + 1), {}, f"got {MAX_VIEWS + 1}"),
        "first without pose": ([replace(first, T_world_camera=None), second], {}, "view 1 of 2 has no T_world_camera"),
        "second without pose": ([first, replace(second, T_world_camera=None)], {}, "view 2 of 2 has no T_world"),
        "fused already": ([first, fused], {}, "view 2 of 2 is fused already"),
        "times missing": ([first, second], {"taken_s": [1.0]}, "must be 2 finite times"),
        "a time is not one": ([first, second], {"taken_s": [1.0, math.nan]}, "must be 2 finite times"),
        "stale": ([first, second], {"taken_s": [5.0, 2.5]}, r"2.50 s apart \(allowed 1 s\)"),
    }


@pytest.mark.parametrize("name", sorted(bad_inputs()))
def test_bad_frames_are_refused(name):
    frames, options, message = bad_inputs()[name]
    with pytest.raises(InputError, match=message):
        fuse(frames, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options", [{"voxel_m": 0}, {"voxel_m": math.nan}, {"max_apart_s": -1}, {"max_disagreement_m": 1}]
)
def test_bad_settings_are_refused(options):
    with pytest.raises(ConfigError, match="fusion: need"):
        fuse([shot(FRONT), shot(BACK)], **options)


def test_times_that_fit_are_taken():
    assert fuse([shot(FRONT), shot(BACK)], taken_s=[3.0, 3.4]).others is not None


def test_a_view_without_any_return_adds_nothing():
    blind = replace(shot(BACK), depth=np.zeros_like(shot(BACK).depth))
    others = fuse([shot(FRONT), blind]).others
    assert others is not None
    assert (len(others.points), others.agrees) == (0, (False,))
    lonely = fuse([replace(shot(FRONT), depth=np.full_like(shot(FRONT).depth, np.nan)), shot(BACK)])
    assert lonely.others is not None
    assert lonely.others.agrees == (False,)


def test_infinite_depth_is_no_return():
    back = shot(BACK)
    cut = np.where(back.depth > 0.7, np.float32(np.inf), back.depth)
    holes = np.where(back.depth > 0.7, np.float32(0), back.depth)
    infinite, none = (fuse([shot(FRONT), replace(back, depth=d)]) for d in (cut, holes))
    assert infinite.others is not None
    assert none.others is not None
    assert np.array_equal(infinite.others.points, none.others.points)
    points = apply(invert(shot(FRONT).T_world_camera), np.array([[0.02, 0.09, 0.09], [0.1, 0.2, 0.1]]))  # type: ignore[arg-type]
    assert np.array_equal(seen_free(infinite, points), seen_free(none, points))


def test_views_of_other_sizes_and_nan_depth_are_taken():
    small = view(t.box("box", BOX_M, RED, t.pose(*BOX_AT)), eye=BACK, size=(200, 150), noise=False).frame
    depth = np.where(small.depth > 0, small.depth, np.float32(np.nan))
    depth[:20] = np.nan
    world = added(fuse([shot(FRONT, hidden=False), replace(small, depth=depth)]))
    assert len(world) > 100
    assert off_surface(world).max() < 0.004


def test_other_views_keep_their_contract():
    f = np.float32
    good: dict[str, object] = {
        "frames": (shot(BACK),),
        "points": np.zeros((2, 3), f),
        "normals": np.zeros((2, 3), f),
        "colors": np.zeros((2, 3), np.uint8),
        "view": np.zeros(2, np.uint8),
        "disagreement_m": (0.0,),
        "agrees": (True,),
    }
    assert OtherViews(**good).agreeing().all()  # type: ignore[arg-type]
    for name, value in {"normals": np.zeros((1, 3), f), "view": np.ones(2, np.uint8), "agrees": ()}.items():
        with pytest.raises(ContractError, match="OtherViews"):
            OtherViews(**(good | {name: value}))  # type: ignore[arg-type]


def test_the_command_line_takes_more_views(cli, tmp_path):
    for name, eye in (("a", FRONT), ("b", BACK)):
        (tmp_path / name).mkdir()
        save_frame(shot(eye, noise=True), tmp_path / name)
    a, b = ([str(tmp_path / n / f) for f in ("color.png", "depth.png", "camera.json")] for n in "ab")
    one = cli("grasp", a[0], a[1], "the red box", "--camera", a[2])
    two = cli("grasp", a[0], a[1], "the red box", "--camera", a[2], "--also", *b)
    assert (one.code, two.code) == (0, 0)
    assert two.err.startswith("2 views fused: ")
    text = (tmp_path / "b" / "camera.json").read_text()
    (tmp_path / "b" / "camera.json").write_text(text.replace("T_world_camera", "T"))
    wrong = cli("grasp", a[0], a[1], "the red box", "--camera", a[2], "--also", *b)
    assert wrong.code == 2
    assert wrong.err.startswith("error: view 2 of 2 has no T_world_camera")
    assert cli("grasp", a[0], a[1], "the red box", "--camera", a[2], "--also", *b[:2]).code == 2


def test_white_is_no_hole():
    """A light box, whose colour is near the table's, is fused like any other."""
    frames = [
        view(t.box("w", BOX_M, WHITE, t.pose(*BOX_AT)), eye=e, size=SIZE, noise=True).frame for e in (FRONT, BACK)
    ]
    others = fuse(frames).others
    assert others is not None
    assert all(others.agrees)
