import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thinkgrasp.checks.cloud import BlockedCloud
from thinkgrasp.checks.collision import CollisionCheck, TableClearanceCheck, body_boxes, lowest_corner
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import GRIPPERS, Gripper
from thinkgrasp.types import CameraIntrinsics, Frame, Grasps, Scene, Segment, SupportPlane

GRIPPER = Gripper.load("robotiq_2f85")
DOWN = np.eye(3)
"""The camera looks straight down, so the approach is the optical axis."""


def random_grasps(n: int, seed: int, spread: float = 0.05, z: float = 0.6) -> Grasps:
    rng = np.random.default_rng(seed)
    return Grasps(
        Rotation.random(n, rng=rng).as_matrix().astype(np.float32),
        (rng.uniform(-spread, spread, (n, 3)) + np.array([0, 0, z])).astype(np.float32),
        rng.uniform(0.01, 0.085, n).astype(np.float32),
        np.ones(n, np.float32),
    )


def one(position, rotation=DOWN, width=0.06) -> Grasps:
    f = np.float32
    return Grasps(np.asarray(rotation, f)[None], np.array([position], f), np.array([width], f), np.ones(1, f))


def scene_of(points: np.ndarray, support: SupportPlane | None = None) -> Scene:
    """A cloud as a one-row image; the checks read only its points."""
    n = len(points)
    camera = CameraIntrinsics(n, 1, 500.0, 500.0, 0.0, 0.0)
    depth = np.ones((1, n), np.float32)
    frame = Frame(np.zeros((1, n, 3), np.uint8), depth, camera)
    return Scene(frame, points.astype(np.float32)[None], support=support)


def target(scene: Scene) -> Segment:
    return Segment("x", 1.0, np.ones(scene.points.shape[:2], bool), (0, 0, scene.points.shape[1], 1), False)


def points_inside(points: np.ndarray, grasps: Grasps, index: int, gripper: Gripper, standoff: float) -> int:
    """Count by brute force, at the grasp and at 1 mm steps back along the approach."""
    R, p = grasps.rotations[index].astype(float), grasps.positions[index].astype(float)
    local = (points - p) @ R
    count = 0
    for back in np.arange(0, standoff + 1e-9, 0.001):
        moved = local + np.array([0, 0, back])
        for low, high in gripper.bodies(float(grasps.widths[index])):
            count += int(((moved >= low) & (moved <= high)).all(axis=1).sum())
    return count


@pytest.mark.parametrize("name", sorted(GRIPPERS))
def test_agrees_with_brute_force(name):
    gripper = GRIPPERS[name]
    rng = np.random.default_rng(3)
    clusters = rng.uniform(-0.2, 0.2, (25, 3)) + np.array([0, 0, 0.6])
    points = (clusters[:, None] + rng.normal(scale=0.008, size=(25, 40, 3))).reshape(-1, 3)
    points[::50] = np.nan
    scene = scene_of(points)
    grasps = random_grasps(150, 5)
    kept = CollisionCheck(margin_m=0.0, standoff_m=0.05).keep(scene, target(scene), grasps, gripper)
    finite = points[np.isfinite(points[:, 0])].astype(np.float32).astype(float)
    expected = np.array([points_inside(finite, grasps, i, gripper, 0.05) == 0 for i in range(len(grasps))])
    # Brute force steps by 1 mm and may miss what the exact sweep meets, never the other way round.
    assert expected[kept].all()
    assert (kept == expected).mean() > 0.98
    assert 10 < kept.sum() < 140


def test_between_the_fingers_is_free_and_everything_else_is_not():
    position = (0, 0, 0.6)
    half, t = 0.03, GRIPPER.finger_thickness_m
    cases = {
        "between": ([0, 0, -0.01], True),
        "in a finger": ([half + t / 2, 0, -0.01], False),
        "in the other finger": ([-half - t / 2, 0, -0.03], False),
        "in the palm": ([0, 0, -GRIPPER.finger_length_m - 0.01], False),
        "where the palm comes from": ([0, 0, -GRIPPER.finger_length_m - GRIPPER.palm_size_m[2] - 0.05], False),
        "where a finger comes from": ([half + t / 2, 0, -GRIPPER.finger_length_m - 0.15], False),
        "below the tips": ([half + t / 2, 0, 0.02], True),
        "beside": ([half + t + 0.02, 0, -0.01], True),
    }
    for name, (offset, free) in cases.items():
        scene = scene_of(np.array([position]) + np.array([offset]))
        assert CollisionCheck().keep(scene, target(scene), one(position), GRIPPER)[0] == free, name


def test_margin_enlarges_the_bodies():
    scene = scene_of(np.array([[0.03 - 0.002, 0, 0.59]]))
    grasp = one((0, 0, 0.6))
    assert CollisionCheck(margin_m=0.001).keep(scene, target(scene), grasp, GRIPPER)[0]
    assert not CollisionCheck(margin_m=0.003).keep(scene, target(scene), grasp, GRIPPER)[0]


def test_standoff_lengthens_the_approach():
    far_back = GRIPPER.finger_length_m + GRIPPER.palm_size_m[2] + 0.08
    scene = scene_of(np.array([[0, 0, 0.6 - far_back]]))
    assert CollisionCheck(standoff_m=0.05).keep(scene, target(scene), one((0, 0, 0.6)), GRIPPER)[0]
    assert not CollisionCheck(standoff_m=0.10).keep(scene, target(scene), one((0, 0, 0.6)), GRIPPER)[0]


def test_an_empty_cloud_stops_nothing():
    scene = scene_of(np.full((5, 3), np.nan))
    assert CollisionCheck().keep(scene, target(scene), random_grasps(4, 0), GRIPPER).all()
    assert CollisionCheck().keep(scene, target(scene), Grasps.empty(), GRIPPER).shape == (0,)


def test_table_clearance_measures_the_lowest_corner():
    support = SupportPlane(np.array([0.0, 0, -1]), 0.7, np.ones((1, 1), bool), 0.0)
    scene = scene_of(np.array([[0, 0, 0.7]]), support)
    check = TableClearanceCheck(margin_m=0.003)
    assert check.keep(scene, target(scene), one((0, 0, 0.696)), GRIPPER)[0]
    assert not check.keep(scene, target(scene), one((0, 0, 0.698)), GRIPPER)[0]
    tilted = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    assert not check.keep(scene, target(scene), one((0, 0, 0.69), tilted), GRIPPER)[0], "an outer finger edge dips in"
    flat = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    assert not check.keep(scene, target(scene), one((0, 0, 0.66), flat), GRIPPER)[0], "the palm dips in"
    free = scene_of(np.array([[0, 0, 0.7]]))
    assert check.keep(free, target(free), one((0, 0, 0.9)), GRIPPER)[0], "without a support nothing is dropped"


def test_lowest_corner_is_the_minimum_over_all_corners():
    grasps = random_grasps(20, 1)
    up = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    lowest = lowest_corner(grasps, body_boxes(grasps, GRIPPER), up)
    for i, g in enumerate(grasps):
        corners = np.array(
            [[box[s[k], k] for k in range(3)] for box in GRIPPER.bodies(g.width_m) for s in np.ndindex(2, 2, 2)]
        )
        assert lowest[i] == pytest.approx((corners @ g.rotation.T + g.position).dot(up).min(), abs=1e-6)


@pytest.mark.parametrize("block_m", [0.003, 0.02, 1.0])
def test_blocked_cloud_finds_every_point(block_m):
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.1, 0.1, (2000, 3)) + np.array([0, 0, 0.6])
    grasps = random_grasps(30, 7)
    low, high = np.tile([-0.02, -0.01, -0.05], (30, 1)), np.tile([0.02, 0.01, 0.03], (30, 1))
    index, local = BlockedCloud.of(points, block_m).inside(grasps, low, high)
    for i in range(30):
        truth = (points - grasps.positions[i]) @ grasps.rotations[i]
        truth = truth[((truth >= low[i]) & (truth <= high[i])).all(axis=1)]
        found = local[index == i]
        assert len(found) == len(truth)
        np.testing.assert_allclose(np.sort(found[:, 0]), np.sort(truth[:, 0]), atol=1e-6)


@pytest.mark.parametrize(
    ("check", "settings"),
    [
        (CollisionCheck, {"margin_m": -0.001}),
        (CollisionCheck, {"standoff_m": -1}),
        (CollisionCheck, {"voxel_m": 0}),
        (TableClearanceCheck, {"margin_m": np.inf}),
    ],
)
def test_settings_out_of_range(check, settings):
    with pytest.raises(ConfigError, match="check"):
        check(**settings)
