"""The score of two contacts, and the check that uses it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thinkgrasp.checks.force_closure import (
    ForceClosureCheck,
    closure_score,
    contact_angles,
    force_closure_score,
    friction_of_angle,
    smallest_friction,
)
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import CameraIntrinsics, Frame, Grasps, Scene, Segment

SEEDS = st.integers(0, 2**32 - 1)


def contacts(seed: int, n: int = 50):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, n, 3)) * 0.05
    # Normals near the line, so that closed and open pairs both occur.
    line = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    na, nb = -line + rng.normal(size=(n, 3)) * 0.4, line + rng.normal(size=(n, 3)) * 0.4
    return a, b, na / np.linalg.norm(na, axis=1, keepdims=True), nb / np.linalg.norm(nb, axis=1, keepdims=True)


def pair_at(angle_a: float, angle_b: float):
    """Contacts 4 cm apart on x, with the outward normals turned off the line by these angles."""
    a, b = np.array([[-0.02, 0, 0]]), np.array([[0.02, 0, 0]])
    na = np.array([[-np.cos(angle_a), np.sin(angle_a), 0]])
    nb = np.array([[np.cos(angle_b), 0, np.sin(angle_b)]])
    return a, b, na, nb


@given(SEEDS)
def test_order_of_the_contacts_does_not_matter(seed):
    a, b, na, nb = contacts(seed)
    np.testing.assert_array_equal(smallest_friction(a, b, na, nb), smallest_friction(b, a, nb, na))


@given(SEEDS)
def test_rotation_translation_and_scale_do_not_matter(seed):
    a, b, na, nb = contacts(seed)
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    shift = np.array([0.3, -0.2, 1.0])
    moved = smallest_friction(a @ R.T * 3 + shift, b @ R.T * 3 + shift, na @ R.T, nb @ R.T)
    angles = np.maximum(*contact_angles(a, b, na, nb))
    steps = np.arctan(np.arange(0.1, 1.05, 0.1))
    clear_of_steps = np.abs(angles[:, None] - steps).min(axis=1) > 1e-6
    np.testing.assert_array_equal(moved[clear_of_steps], smallest_friction(a, b, na, nb)[clear_of_steps])


@given(SEEDS)
def test_scores_are_the_ten_steps_or_zero_for_open_pairs(seed):
    pairs = contacts(seed)
    score, friction = force_closure_score(*pairs), smallest_friction(*pairs)
    closed = np.isfinite(friction)
    np.testing.assert_allclose(score[closed], 1.1 - friction[closed])
    assert ((score[closed] > 0) & (score[closed] <= 1)).all()
    assert (score[~closed] == 0).all()
    np.testing.assert_allclose(np.round(friction[closed] * 10), friction[closed] * 10)


@given(st.floats(0, np.pi / 2), st.floats(0, np.pi / 2))
def test_larger_angles_never_score_better(one, other):
    low, high = sorted((one, other))
    assert friction_of_angle(np.array([low]))[0] <= friction_of_angle(np.array([high]))[0]
    assert closure_score(friction_of_angle(np.array([low])))[0] >= closure_score(friction_of_angle(np.array([high])))[0]


@pytest.mark.parametrize("mu", [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
def test_each_cone_holds_its_edge_and_nothing_beyond(mu):
    edge = np.arctan(mu)
    assert smallest_friction(*pair_at(edge, 0.0))[0] == pytest.approx(mu)
    assert smallest_friction(*pair_at(0.0, edge))[0] == pytest.approx(mu)
    beyond = smallest_friction(*pair_at(edge + 1e-4, 0.0))[0]
    assert beyond == pytest.approx(mu + 0.1) if mu < 1 else np.isinf(beyond)


def test_known_pairs():
    assert force_closure_score(*pair_at(0, 0))[0] == pytest.approx(1.0)
    assert force_closure_score(*pair_at(np.deg2rad(30), np.deg2rad(10)))[0] == pytest.approx(0.5)
    assert force_closure_score(*pair_at(np.deg2rad(50), 0))[0] == 0
    a, b, na, nb = pair_at(0, 0)
    assert force_closure_score(a, b, -na, -nb)[0] == 0, "pressing from inside does not close"
    assert force_closure_score(a, a, na, nb)[0] == 0, "coinciding contacts do not close"


def test_no_pairs():
    none = np.zeros((0, 3))
    assert smallest_friction(none, none, none, none).shape == (0,)


def flat_scene() -> tuple[Scene, Segment]:
    camera = CameraIntrinsics(40, 30, 40.0, 40.0, 19.5, 14.5)
    v, u = np.mgrid[0:30, 0:40].astype(np.float32)
    depth = np.full((30, 40), 0.5, np.float32)
    points = np.stack([(u - 19.5) / 40 * depth, (v - 14.5) / 40 * depth, depth], -1)
    frame = Frame(np.zeros((30, 40, 3), np.uint8), depth, camera)
    return Scene(frame, points), Segment("x", 1.0, np.ones((30, 40), bool), (0, 0, 40, 30), False)


def facing_grasps(z: list[float], score: list[float]) -> Grasps:
    n = len(z)
    position = np.array([[0, 0, d] for d in z], np.float32)
    return Grasps(
        np.repeat(np.eye(3, dtype=np.float32)[None], n, axis=0),
        position,
        np.full(n, 0.08, np.float32),
        np.array(score, np.float32),
    )


def test_check_drops_low_scores_and_grasps_on_nothing():
    scene, target = flat_scene()
    grasps = facing_grasps([0.52, 0.45, 0.52], [0.9, 0.9, 0.01])
    gripper = Gripper.load("robotiq_2f85")
    assert ForceClosureCheck().keep(scene, target, grasps, gripper).tolist() == [True, False, False]
    unasked = ForceClosureCheck(min_points=0).keep(scene, target, grasps, gripper)
    assert unasked.tolist() == [True, True, False]


@pytest.mark.parametrize("settings", [{"min_score": -0.1}, {"min_score": 1.1}, {"min_points": -1}])
def test_settings_out_of_range(settings):
    with pytest.raises(ConfigError, match="force closure check"):
        ForceClosureCheck(**settings)
