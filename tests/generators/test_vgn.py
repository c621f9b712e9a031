"""VGN's voxels become grasps of our gripper: where they belong, as wide as they must be, and never an exception."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from fakes import two_views
from fakes.networks import untrained_vgn

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from thinkgrasp.errors import ConfigError, MissingDependency  # noqa: E402
from thinkgrasp.generators import vgn as generator_module  # noqa: E402
from thinkgrasp.generators.vgn import VgnGenerator  # noqa: E402
from thinkgrasp.generators.vgn_antipodal import VgnAntipodalGenerator  # noqa: E402
from thinkgrasp.geometry import deproject  # noqa: E402
from thinkgrasp.gripper import GRIPPERS  # noqa: E402
from thinkgrasp.networks import vgn  # noqa: E402
from thinkgrasp.networks.tsdf import fuse  # noqa: E402
from thinkgrasp.testing import sample_scene, strict_scene  # noqa: E402
from thinkgrasp.types import Frame, Grasps, Scene, SupportPlane  # noqa: E402

WEIGHTS = Path(__file__).parents[3] / "shared" / "vgn" / "vgn_conv.pth"
GRIPPER = GRIPPERS["robotiq_2f85"]
needs_weights = pytest.mark.skipif(not WEIGHTS.is_file(), reason=f"no weights at {WEIGHTS}")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return untrained_vgn(tmp_path_factory.mktemp("weights"))


@lru_cache(maxsize=2)
def trained(**settings: object) -> VgnGenerator:
    return VgnGenerator(weights=WEIGHTS, **settings)


def generate(generator, scene: Scene, crop: np.ndarray, gripper=GRIPPER) -> Grasps:
    return generator.generate(scene, crop, gripper, np.random.default_rng(0))


# -- the real network -------------------------------------------------------------------------------------------------


@needs_weights
@pytest.mark.parametrize("scene", [sample_scene(), strict_scene()], ids=["support plane", "camera pose alone"])
def test_things_on_a_table_are_grasped_from_above_where_they_are(scene):
    full = sample_scene()
    up = full.support.normal
    found = 0
    for proposal in full.proposals:
        grasps = generate(trained(), scene, proposal.mask)
        if not len(grasps):
            continue
        found += 1
        best = grasps[:20]
        assert (best.rotations[:, :, 2] @ -up > 0).mean() > 0.9
        seen = scene.points[proposal.mask & np.isfinite(scene.points[..., 2])]
        reach = np.linalg.norm(best.positions[:, None] - seen, axis=2).min(axis=1)
        assert np.median(reach) < 0.03
        assert (full.support.height(best.positions) > 0).all()
        assert (np.diff(grasps.scores) <= 0).all()
    assert found >= 8


@needs_weights
def test_a_fitted_grasp_opens_no_wider_than_it_must_and_never_wider_than_the_gripper():
    scene = sample_scene()
    mask = scene.proposals[3].mask
    fitted, opened = (generate(trained(fit=fit), scene, mask) for fit in (True, False))
    assert (fitted.widths <= GRIPPER.max_width_m).all()
    assert (opened.widths <= GRIPPER.max_width_m).all()
    assert np.median(fitted.widths) < 0.9 * GRIPPER.max_width_m
    assert (opened.widths > GRIPPER.max_width_m - 1e-6).all()


@needs_weights
def test_fewer_turns_and_maxima_alone_give_fewer_grasps():
    scene = sample_scene()
    mask = scene.proposals[7].mask
    many = generate(trained(fit=False, n_yaws=2), scene, mask)
    few = generate(trained(fit=False, n_yaws=1, only_maxima=True), scene, mask)
    assert len(many) > len(few) > 0


@needs_weights
def test_both_generators_together_propose_what_either_does():
    scene = sample_scene()
    mask = scene.proposals[3].mask
    both = VgnAntipodalGenerator(weights=WEIGHTS, ranking="own", vgn={"n_yaws": 1})
    own = generate(both, scene, mask)
    parts = [generate(g, scene, mask) for g in (both.vgn, both.antipodal)]
    assert len(own) == sum(len(p) for p in parts)
    joint = VgnAntipodalGenerator(weights=WEIGHTS, ranking="joint", vgn={"n_yaws": 1})
    ranked = generate(joint, scene, mask)
    assert len(ranked) == len(own)
    best = max(float(p.scores.max()) for p in parts)
    assert best / 2 < ranked.scores[0] <= best


# -- one voxel of which everything is known ---------------------------------------------------------------------------

INDEX = (20, 20, 14)
DEPTH_M = 0.7


def ball_on_a_table() -> tuple[Scene, np.ndarray]:
    """A camera looking straight down on a table, and a disc of 3 cm, 4 cm high, under its centre."""
    from thinkgrasp.types import CameraIntrinsics

    camera = CameraIntrinsics(161, 121, 200.0, 200.0, 80.0, 60.0)
    depth = np.full((121, 161), DEPTH_M, np.float32)
    v, u = np.mgrid[:121, :161]
    crop = (u - 80) ** 2 + (v - 60) ** 2 <= 4.5**2
    depth[crop] = DEPTH_M - 0.04
    points = deproject(depth, camera)
    support = SupportPlane(np.array([0.0, 0.0, -1.0]), DEPTH_M, ~crop, 0.0)
    frame = Frame(np.zeros((121, 161, 3), np.uint8), depth, camera)
    return Scene(frame, points, support=support), crop


def one_voxel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the network believe in one voxel: straight down, closing along the cube's x."""

    def predict(network: vgn.Vgn, grids: np.ndarray) -> list[vgn.Prediction]:
        quality = np.zeros((40, 40, 40), np.float32)
        quality[INDEX] = 0.95
        half = np.sqrt(0.5)
        rotation = np.tile(np.array([half, half, 0, 0], np.float32)[:, None, None, None], (1, 40, 40, 40))
        return [vgn.Prediction(quality, rotation, np.full((40, 40, 40), 5, np.float32)) for _ in grids]

    monkeypatch.setattr(vgn, "predict", predict)
    monkeypatch.setattr(vgn, "process_quality", lambda grid, raw, *, variant: raw.quality)


@pytest.mark.parametrize("scale", [1.0, 1.0625, None])
@pytest.mark.parametrize("centring", [True, False])
def test_a_voxel_becomes_the_grasp_with_its_fingertips_there(weights, monkeypatch, scale, centring):
    one_voxel(monkeypatch)
    scene, crop = ball_on_a_table()
    generator = VgnGenerator(weights=weights, scale=scale, centring=centring, fit=False, n_yaws=1)
    s = scale or 1.0625  # 0.085 m over 0.080 m; fingers of 60 mm are long enough
    grasps = generate(generator, scene, crop)
    assert len(grasps) == 1
    R, p = grasps.rotations[0], grasps.positions[0]
    np.testing.assert_allclose(R[:, 2], [0, 0, 1], atol=1e-6)  # approach: down, which is along the view
    voxel = 0.3 * s / 40
    palm_height = INDEX[2] * voxel - 0.05 * s
    height = max(palm_height - 0.05 * s, 0.006)  # kept above the support
    assert DEPTH_M - p[2] == pytest.approx(height, abs=1e-5)
    offset = ((20 + 0.5 * centring) * voxel - 0.15 * s) * np.array([1, 1])
    up, away = np.array([0, 0, -1.0]), np.array([0, -1.0, 0])  # image up is "away" for a camera that looks down
    level = np.array([p @ away, p @ np.cross(up, away)])
    np.testing.assert_allclose(level, offset, atol=1e-5)
    assert abs(R[:, 0] @ away) == pytest.approx(1, abs=1e-6)  # the hand closes along its y: here the cube's x
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-5)


def test_a_fitted_grasp_is_centred_on_the_thing_with_room_to_each_side(weights, monkeypatch):
    one_voxel(monkeypatch)
    scene, crop = ball_on_a_table()
    grasps = generate(VgnGenerator(weights=weights, centring=True, n_yaws=1), scene, crop)
    assert len(grasps) == 1
    closing = grasps.rotations[0][:, 0]
    assert grasps.positions[0] @ closing == pytest.approx(0, abs=2e-3)
    assert grasps.widths[0] == pytest.approx(0.03 + 2 * 0.007, abs=4e-3)


def test_a_gripper_with_short_fingers_keeps_the_scale_that_they_reach():
    generator = VgnGenerator.__new__(VgnGenerator)
    generator.scale = None
    short = replace(GRIPPER, max_width_m=0.14, finger_length_m=0.055)
    assert generator._scale(GRIPPER) == pytest.approx(1.0625)
    assert generator._scale(GRIPPERS["franka_hand"]) == pytest.approx(1.0)
    assert generator._scale(short) == pytest.approx(1.1)


# -- odd input --------------------------------------------------------------------------------------------------------


def ready(weights: Path) -> VgnGenerator:
    """A network that calls every valid voxel about 0.5, and believes it."""
    return VgnGenerator(weights=weights, threshold=0.3, variant="devel", n_yaws=1)


def test_nothing_under_the_crop_gives_nothing(weights):
    scene = sample_scene()
    nothing = np.zeros(scene.frame.depth.shape, bool)
    blind = ~np.isfinite(scene.points[..., 2])
    assert len(generate(ready(weights), scene, nothing)) == 0
    assert len(generate(ready(weights), scene, blind)) == 0


def test_a_cloud_without_any_return_gives_nothing(weights):
    scene = sample_scene()
    depth = np.full_like(scene.frame.depth, np.nan)
    frame = replace(scene.frame, depth=depth)
    dark = Scene(frame, deproject(depth, frame.camera))
    assert len(generate(ready(weights), dark, scene.proposals[0].mask)) == 0


def test_holes_in_the_cloud_do_no_harm(weights):
    scene = sample_scene()
    depth = scene.frame.depth.copy()
    depth[np.random.default_rng(0).random(depth.shape) < 0.5] = np.nan
    frame = replace(scene.frame, depth=depth)
    holes = replace(scene, frame=frame, points=deproject(depth, frame.camera))
    grasps = generate(ready(weights), holes, scene.proposals[0].mask)
    assert np.isfinite(grasps.positions).all()
    assert np.isfinite(grasps.rotations).all()


@pytest.mark.parametrize("n_pixels", [1, 9])
def test_a_few_pixels_give_no_exception(weights, n_pixels):
    scene = sample_scene()
    crop = np.zeros(scene.frame.depth.shape, bool)
    v, u = np.nonzero(scene.proposals[0].mask & np.isfinite(scene.points[..., 2]))
    crop[v[:n_pixels], u[:n_pixels]] = True
    assert np.isfinite(generate(ready(weights), scene, crop).positions).all()


@pytest.mark.parametrize("factor", [1000.0, 0.001], ids=["millimetres as metres", "metres as kilometres"])
def test_a_scene_in_wrong_units_gives_nothing_and_does_not_take_long(weights, factor):
    scene = sample_scene()
    depth = scene.frame.depth * np.float32(factor)
    frame = replace(scene.frame, depth=depth)
    support = replace(scene.support, offset_m=scene.support.offset_m * factor)
    wrong = replace(scene, frame=frame, points=deproject(depth, frame.camera), support=support, normals=None)
    crop = np.logical_or.reduce([p.mask for p in scene.proposals])
    generator = VgnGenerator(weights=weights, threshold=0.3, variant="devel", n_yaws=1, max_cubes=2)
    assert np.isfinite(generate(generator, wrong, crop).positions).all()


def test_all_that_is_seen_may_be_the_crop(weights):
    scene = sample_scene()
    generator = VgnGenerator(weights=weights, threshold=0.3, variant="devel", n_yaws=1, max_cubes=2, max_grasps=50)
    grasps = generate(generator, scene, np.isfinite(scene.points[..., 2]))
    assert len(grasps) <= 50 * (len(scene.proposals) + 1)


# -- settings ---------------------------------------------------------------------------------------------------------


def test_without_weights_it_says_where_to_get_them_and_under_which_licence():
    with pytest.raises(
        ConfigError, match=r"vgn_conv\.pth is not on.*BSD-3-Clause.*github\.com/ethz-asl/vgn.*--weights FILE"
    ):
        VgnGenerator()
    with pytest.raises(ConfigError, match=r"no_such\.pth does not exist"):
        VgnGenerator(weights="no_such.pth")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"variant": "icra2021"}, "no variant 'icra2021'; allowed are corl2020, devel"),
        ({"threshold": 1.0}, r"threshold must lie in \(0, 1\), got 1.0"),
        ({"scale": 0.0}, r"scale must lie in \(0, 10\)"),
        ({"n_yaws": 0}, "n_yaws must be a whole number of at least 1, got 0"),
        ({"max_cubes": 1.5}, "max_cubes must be a whole number"),
        ({"max_grasps": True}, "max_grasps must be a whole number"),
        ({"clearance_m": 0.001}, "need 0 < min_clearance_m <= clearance_m"),
        ({"tip_height_m": -0.1}, "tip_height_m must be at least 0"),
        ({"body_margin_m": np.nan}, "body_margin_m must be at least 0"),
        ({"device": "abacus"}, "device 'abacus' cannot be used here"),
    ],
)
def test_settings_out_of_range_are_refused(weights, settings, message):
    with pytest.raises(ConfigError, match=message):
        VgnGenerator(weights=weights, **settings)


def test_an_unknown_ranking_is_refused(weights):
    with pytest.raises(ConfigError, match="ranking must be 'own' or 'joint', got 'best'"):
        VgnAntipodalGenerator(weights=weights, ranking="best")


def test_without_torch_it_says_what_to_install(monkeypatch):
    import importlib
    import sys

    for name in [m for m in sys.modules if m.startswith("thinkgrasp.networks.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "thinkgrasp.generators.vgn")
    with pytest.raises(MissingDependency, match=r"pip install 'thinkgrasp\[graspnet\]'"):
        importlib.import_module("thinkgrasp.generators.vgn")


def test_the_scene_is_left_as_it_was(weights):
    scene = strict_scene()
    before = scene.points.copy(), scene.frame.depth.copy()
    generate(ready(weights), scene, sample_scene().proposals[0].mask)
    np.testing.assert_array_equal(scene.points, before[0])
    np.testing.assert_array_equal(scene.frame.depth, before[1])
    assert scene.support is None


@pytest.mark.parametrize(("good", "views"), [(True, 2), (False, 1)])
def test_all_views_that_agree_are_in_the_networks_field(weights, monkeypatch, good, views):
    scene = two_views.scene()
    others = replace(scene.frame.others, agrees=(good,))
    scene = replace(scene, frame=replace(scene.frame, others=others))
    fused: list[tuple[int, np.ndarray]] = []

    def listening(depth, cameras, T_camera_task, **options):
        fused.append((len(depth), T_camera_task))
        return fuse(depth, cameras, T_camera_task, **options)

    monkeypatch.setattr(generator_module, "fuse", listening)
    generate(VgnGenerator(weights=weights, n_yaws=1), scene, two_views.thing(scene, "red").mask)
    assert {n for n, _ in fused} == {views}
    if good:
        T = [view.T_world_camera for view in (scene.frame, *others.frames)]
        corners = [T[i] @ fused[0][1][i] for i in range(2)]
        assert np.allclose(corners[0], corners[1]), "one cube, seen by both"
