"""The generators that run a grasp network: what it is given, and what becomes of its grasps."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from fakes import two_views  # noqa: E402
from fakes.grasp_networks import random_weights, save, table_cloud  # noqa: E402

from thinkgrasp import registry  # noqa: E402
from thinkgrasp.errors import ConfigError, InputError, MissingDependency  # noqa: E402
from thinkgrasp.generators import cloud_network  # noqa: E402
from thinkgrasp.generators.cloud_network import CloudNetworkGenerator, sample, to_grasps  # noqa: E402
from thinkgrasp.generators.fgc_graspnet import FGCGraspNetGenerator  # noqa: E402
from thinkgrasp.generators.graspnet import GraspNetGenerator  # noqa: E402
from thinkgrasp.geometry import apply, invert, make_transform  # noqa: E402
from thinkgrasp.gripper import GRIPPERS  # noqa: E402
from thinkgrasp.networks import grasp_views  # noqa: E402
from thinkgrasp.testing import sample_scene  # noqa: E402

GRIPPER = GRIPPERS["robotiq_2f85"]
PLUGINS = {"graspnet": "graspnet", "fgc_graspnet": "fgc"}


def row(score=1.0, width=0.05, depth=0.02, rotation=None, seed=(0.1, 0.2, 0.6)) -> list[float]:
    R = np.eye(3) if rotation is None else rotation
    return [score, width, 0.02, depth, *R.ravel(), *seed, -1]


class Listening:
    """A network that notes what it is given, and answers with one grasp at every 100th wanted point."""

    def __init__(self) -> None:
        self.cloud = self.wanted = np.zeros(0)

    def run(self, cloud, *, wanted):
        self.cloud, self.wanted = cloud, wanted
        rows = [row(score=i, seed=p) for i, p in enumerate(cloud[wanted][::100])]
        return SimpleNamespace(grasps=torch.tensor(np.array(rows, np.float32).reshape(-1, 17)))


class ListeningGenerator(CloudNetworkGenerator):
    name = "listening"
    known = "graspnet-realsense"

    @staticmethod
    def network(weights, device):
        return Listening()

    @staticmethod
    def quality(scores):
        return scores / np.float32(1000)


@pytest.fixture
def weights(tmp_path):
    torch.save({"w": torch.zeros(1)}, tmp_path / "w.pth")
    return tmp_path / "w.pth"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    return {n: save(folder / f"{n}.tar", random_weights(net)) for n, net in PLUGINS.items()}


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_network_sees_the_crop_with_its_surroundings(weights):
    scene = sample_scene()
    crop = scene.proposals[0].mask
    generator = ListeningGenerator(weights=weights, device="cpu", num_point=4000)
    grasps = generator.generate(scene, crop, GRIPPER, rng())
    heard = generator._network
    assert heard.cloud.shape == (4000, 3)
    assert heard.cloud.dtype == np.float32
    assert 0 < heard.wanted.mean() < 0.9
    seen = scene.points[crop & np.isfinite(scene.points[..., 2])]
    inside = {tuple(p) for p in seen}
    assert all(tuple(p) in inside for p in heard.cloud[heard.wanted])
    assert not any(tuple(p) in inside for p in heard.cloud[~heard.wanted])
    low, high = seen.min(axis=0) - 0.2, seen.max(axis=0) + 0.2
    assert ((heard.cloud >= low) & (heard.cloud <= high)).all()
    near_table = scene.support.inliers & ((scene.points >= low + 0.05) & (scene.points <= high - 0.05)).all(axis=2)
    assert near_table.any()
    height = scene.support.height(heard.cloud)
    assert (np.abs(height) < 0.005).mean() > 0.2, "the table stays in"
    assert grasps.scores.tolist() == sorted(grasps.scores, reverse=True)


def test_the_network_sees_what_other_cameras_saw_and_starts_on_the_things_other_sides(weights):
    fused = two_views.scene()
    alone = replace(fused, frame=replace(fused.frame, others=None))
    crop = two_views.thing(fused, "red").mask
    clouds, starts = [], []
    for scene in (alone, fused):
        generator = ListeningGenerator(weights=weights, device="cpu", num_point=60_000)
        generator.generate(scene, crop, GRIPPER, rng())
        T = scene.frame.T_world_camera
        clouds.append(apply(T, np.unique(generator._network.cloud, axis=0)))
        starts.append(apply(T, np.unique(generator._network.cloud[generator._network.wanted], axis=0)))
    back = [(np.abs(s[:, 1] - two_views.BOX_M[1] / 2) < 0.004) & (s[:, 2] < 0.09) for s in starts]
    assert back[0].sum() == 0
    assert back[1].sum() > 50, "seeds on the back of the box"
    behind = [((c[:, 1] > 0.03) & (np.abs(c[:, 0] + 0.05) < 0.03) & (c[:, 2] > 0.01)).sum() for c in clouds]
    assert behind[0] < 20 < 100 < behind[1], "the hidden box is in the network's cloud"
    beyond = [int((s[:, 1] > 0.035).sum()) for s in starts]
    assert beyond[1] <= beyond[0] + 3, "but no grasp starts on it"


def test_the_workspace_mask_holds(weights):
    scene = sample_scene()
    crop = scene.proposals[0].mask
    allowed = np.zeros_like(crop)
    allowed[:, : int(np.median(np.nonzero(crop)[1]))] = True
    scene = replace(scene, frame=replace(scene.frame, workspace=allowed))
    generator = ListeningGenerator(weights=weights, device="cpu", num_point=2000)
    generator.generate(scene, crop, GRIPPER, rng())
    pixels = scene.frame.camera.project(generator._network.cloud)
    assert (np.rint(pixels[:, 0]) < np.flatnonzero(allowed[0]).max() + 1.5).all()
    assert len(generator.generate(scene, crop & ~allowed, GRIPPER, rng())) == 0


def test_the_sample_is_seeded_and_random_in_order():
    assert np.array_equal(sample(500, 100, rng()), sample(500, 100, rng()))
    some = sample(500, 100, rng())
    assert len(set(some)) == 100
    assert not np.array_equal(some, np.sort(some))
    more = sample(30, 100, rng())
    assert more[:30].tolist() == list(range(30))
    assert set(more) == set(range(30))
    assert np.array_equal(np.sort(sample(50, 50, rng())), np.arange(50))


def test_the_frame_is_converted():
    """Approach, closing and breadth of the network become z, x and y; the TCP lies at the fingertips."""
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    found = to_grasps(np.array([row(depth=0.03, rotation=rotation)], np.float32), np.ones(1, np.float32), GRIPPER)
    R = found.rotations[0]
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 2], rotation[:, 0], atol=1e-6)
    np.testing.assert_allclose(R[:, 0], rotation[:, 1], atol=1e-6)
    tips = np.array([[0.03, side * 0.025, 0] for side in (-1, 1)]) @ rotation.T + [0.1, 0.2, 0.6]
    ours = np.array([[side * 0.025, 0, 0] for side in (-1, 1)]) @ R.T + found.positions[0]
    np.testing.assert_allclose(tips, ours, atol=1e-6)


@pytest.mark.parametrize(
    ("width", "gripper", "opening"),
    [
        (0.05, 0.085, 0.05),
        (0.095, 0.085, 0.085),  # 79 mm are between the fingers, the rest is margin
        (0.1, 0.085, 0.1),  # the limit of the network: nobody knows how wide it is
        (0.095, 0.078, 0.095),
        (0.1, 0.12, 0.1),
        (0.0, 0.085, 0.0),
    ],
)
def test_the_opening_fits_the_gripper_where_the_margin_allows(width, gripper, opening):
    hand = replace(GRIPPER, max_width_m=gripper)
    found = to_grasps(np.array([row(width=width)], np.float32), np.ones(1, np.float32), hand)
    assert found.widths[0] == pytest.approx(opening, abs=1e-6)
    assert (float(found.widths[0]) <= gripper) == (opening <= gripper)


def test_the_numbers_are_the_networks_own():
    assert (cloud_network.MAX_WIDTH_M, cloud_network.WIDTH_MARGIN) == (
        grasp_views.MAX_WIDTH_M,
        grasp_views.WIDTH_MARGIN,
    )


@pytest.mark.parametrize("generator", [GraspNetGenerator, FGCGraspNetGenerator])
def test_quality_keeps_the_order_and_lies_within_0_and_1(generator):
    scores = np.linspace(-3, 8, 2000, dtype=np.float32)
    quality = generator.quality(scores)
    assert quality.dtype == np.float32
    assert quality.min() == 0
    assert 0.99 < quality.max() <= 1
    assert (np.diff(quality) >= 0).all()
    within = (scores > 0) & (scores < 1)
    assert (np.diff(quality[within]) > 0).all()


def test_quality_of_graspnet_is_the_friction_that_is_not_needed():
    assert GraspNetGenerator.quality(np.log(np.float32([1, 2, 10]))).tolist() == pytest.approx([0, 0.5, 0.9])


def fused() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cloud in a robot's frame, with the transform into the camera's."""
    cloud = table_cloud(3000)
    R = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    T_base_camera = make_transform(R, np.array([0.5, 0.1, 0.8]))
    return cloud, apply(T_base_camera, cloud).astype(np.float32), invert(T_base_camera)


def test_a_fused_cloud_is_seen_from_one_camera(weights):
    cloud, in_base, T_camera_base = fused()
    wanted = cloud[:, 2] < 0.57
    generator = ListeningGenerator(weights=weights, device="cpu", num_point=2000)
    plain = generator.on_cloud(cloud, wanted, GRIPPER, rng())
    given = generator._network.cloud
    found = generator.on_cloud(in_base, wanted, GRIPPER, rng(), T_camera_base)
    np.testing.assert_allclose(generator._network.cloud, given, atol=1e-6)
    back = invert(T_camera_base)
    np.testing.assert_allclose(found.positions, apply(back, plain.positions), atol=1e-6)
    np.testing.assert_allclose(found.rotations, back[:3, :3] @ plain.rotations, atol=1e-6)
    with pytest.raises(InputError, match="behind the camera"):
        generator.on_cloud(in_base - np.float32([0, 0, 1]), wanted, GRIPPER, rng())


def test_at_most_so_many_and_the_best(weights):
    generator = ListeningGenerator(weights=weights, device="cpu", num_point=4000, max_grasps=3)
    found = generator.on_cloud(table_cloud(5000), np.ones(5000, bool), GRIPPER, rng())
    assert found.scores.tolist() == pytest.approx([0.039, 0.038, 0.037])


@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize(
    "cloud",
    [
        np.zeros((0, 3)),
        table_cloud(1),
        table_cloud(10),
        np.full((500, 3), np.nan),
    ],
    ids=["no", "one", "ten", "nan"],
)
def test_too_few_points_give_no_grasps(name, cloud, checkpoints):
    generator = registry.load("generator", name, weights=checkpoints[name], device="cpu", num_point=1024)
    assert len(generator.on_cloud(cloud, np.ones(len(cloud), bool), GRIPPER, rng())) == 0


@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize(
    "cloud",
    [
        np.repeat(table_cloud(30), 40, axis=0),
        np.column_stack([np.random.default_rng(0).uniform(-0.2, 0.2, (2000, 2)), np.full(2000, 0.5)]),
        np.where(np.arange(3000)[:, None] % 3, table_cloud(3000), np.nan),
        np.tile(table_cloud(20_000), (50, 1)),
    ],
    ids=["duplicates", "plane", "some nan", "a million"],
)
def test_odd_clouds_give_proper_grasps(name, cloud, checkpoints):
    generator = registry.load("generator", name, weights=checkpoints[name], device="cpu", num_point=2048)
    found = generator.on_cloud(cloud, np.ones(len(cloud), bool), GRIPPER, rng())
    assert 0 < len(found) <= 512
    R = found.rotations.astype(np.float64)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    assert np.isfinite(found.positions).all()
    assert ((found.scores >= 0) & (found.scores <= 1)).all()
    assert np.array_equal(found.scores, -np.sort(-found.scores))


@pytest.mark.parametrize("name", PLUGINS)
@pytest.mark.parametrize(("scale", "message"), [(1000, "millimetres"), (0.001, "of the origin")])
def test_another_unit_is_named(name, scale, message, checkpoints):
    scene = sample_scene()
    scaled = replace(scene, points=scene.points * np.float32(scale))
    generator = registry.load("generator", name, weights=checkpoints[name], device="cpu", num_point=1024)
    with pytest.raises(InputError, match=message):
        generator.generate(scaled, scene.proposals[0].mask, GRIPPER, rng())


def test_arrays_that_do_not_belong_together_are_named(weights):
    generator = ListeningGenerator(weights=weights, device="cpu")
    with pytest.raises(InputError, match=r"wanted \(N,\) bool"):
        generator.on_cloud(table_cloud(50), np.ones(49, bool), GRIPPER, rng())


@pytest.mark.parametrize("name", PLUGINS)
def test_without_weights_it_says_where_they_are_and_under_which_terms(name):
    with pytest.raises(ConfigError, match=r"non-commercial.*(gdown|github\.com).*--weights FILE"):
        registry.load("generator", name)


@pytest.mark.parametrize("name", PLUGINS)
def test_unusable_weights_are_named(name, tmp_path, weights):
    for path, message in (
        (tmp_path / "none.tar", "does not exist"),
        (tmp_path, "is a folder"),
        (weights, "another model"),
    ):
        with pytest.raises(ConfigError, match=message):
            registry.load("generator", name, weights=path, device="cpu")


@pytest.mark.parametrize(
    "wrong", [{"num_point": 10}, {"num_point": 2e4}, {"max_grasps": 0}, {"margin_m": -1}, {"device": "gpu"}]
)
def test_settings_out_of_range_are_named(wrong, weights):
    with pytest.raises(ConfigError, match="listening generator"):
        ListeningGenerator(**{"weights": weights, "device": "cpu", **wrong})


def test_torch_is_optional(weights, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "thinkgrasp.networks.checkpoint")
    with pytest.raises(MissingDependency, match=r"thinkgrasp\[graspnet\]"):
        GraspNetGenerator(weights=weights)
