"""Any grasp on a mesh or a cloud gets the friction it needs, by the rule of GraspNet-1Billion's evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thinkgrasp.closure import OrientedCloud, TriangleMesh, find_contacts, grasp_friction, pad_friction
from thinkgrasp.contacts import EVALUATED_FRICTIONS, smallest_friction
from thinkgrasp.errors import InputError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.types import Grasps

GOLDEN = Path(__file__).parents[2] / "shared" / "grasp_networks" / "golden_ops.npz"
RADIUS_M = 0.03


def sphere(n: int = 4000) -> OrientedCloud:
    """A ball's surface, evenly sampled along a spiral."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return OrientedCloud(RADIUS_M * normals, normals, radius_m=0.003)


def box(size: tuple[float, float, float] = (0.04, 0.06, 0.1)) -> TriangleMesh:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return TriangleMesh(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def grasps(positions: list[list[float]], yaw: float = 0.0, width: float = 0.08) -> Grasps:
    n = len(positions)
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    return Grasps(
        np.repeat(R[None], n, axis=0), np.array(positions, np.float32), np.full(n, width, np.float32),
        np.ones(n, np.float32),
    )  # fmt: skip


@pytest.mark.skipif(not GOLDEN.is_file(), reason=f"no golden data at {GOLDEN}")
def test_quality_of_contact_pairs_is_the_golden_one():
    with np.load(GOLDEN) as data:
        g = {k.removeprefix("force_closure/"): data[k] for k in data if k.startswith("force_closure/")}
    assert tuple(g["mu"]) == EVALUATED_FRICTIONS
    friction = smallest_friction(
        g["p1"], g["p2"], g["n1"], g["n2"], frictions=EVALUATED_FRICTIONS, oriented=False
    )  # fmt: skip
    np.testing.assert_array_equal(np.where(np.isfinite(friction), friction, -1), g["quality_mu"])
    np.testing.assert_array_equal(friction[:, None] <= g["mu"], g["closed"])


def test_a_chord_of_a_ball_needs_the_tangent_of_its_angle():
    offsets = [0.0, 0.0045, 0.010, 0.015, 0.020, 0.0225]
    needed = np.tan(np.arcsin(np.array(offsets) / RADIUS_M))
    expected = [min(m for m in EVALUATED_FRICTIONS if m >= n) for n in needed]
    found = grasp_friction(grasps([[0, y, 0] for y in offsets]), sphere())
    np.testing.assert_allclose(found, expected, atol=0.2001)  # a cloud's contact is as fine as its points
    assert np.isinf(grasp_friction(grasps([[0, 0.029, 0], [0, 0.05, 0]]), sphere())).all()


def test_contacts_lie_on_the_faces_of_a_box():
    found = find_contacts(grasps([[0.003, 0, 0]], width=0.07), box())
    np.testing.assert_allclose(found.points, [[[-0.02, 0, 0], [0.02, 0, 0]]], atol=1e-7)
    assert (np.abs(found.normals[0, :, 0]) > 0).all()


def test_a_turned_grasp_needs_the_friction_of_its_turn():
    for degrees, expected in ((0, 0.2), (15, 0.4), (30, 0.6), (40, 1.0)):
        assert grasp_friction(grasps([[0, 0, 0]], yaw=np.deg2rad(degrees)), box())[0] == expected


def test_what_a_finger_cannot_meet_is_not_closed():
    narrow = grasps([[0, 0, 0]], width=0.03)  # both fingers begin inside
    beside = grasps([[0.05, 0, 0]], width=0.04)  # the object is on one side
    assert np.isinf(grasp_friction(narrow, box())).all()
    assert np.isinf(grasp_friction(beside, box())).all()


def test_the_orientation_of_faces_and_normals_does_not_matter():
    turned = TriangleMesh(box().vertices, box().faces[:, ::-1])
    batch = grasps([[0, 0, 0], [0, 0.02, 0.03]], yaw=0.2)
    np.testing.assert_array_equal(grasp_friction(batch, box()), grasp_friction(batch, turned))
    ball = sphere()
    inward = OrientedCloud(ball.points, -ball.normals, radius_m=ball.radius_m)
    np.testing.assert_array_equal(grasp_friction(batch, ball), grasp_friction(batch, inward))


def test_the_best_line_of_the_pad_counts():
    deep = grasps([[0, 0, 0.06]])  # the tips are past the box, the pads are not
    assert np.isinf(grasp_friction(deep, box())).all()
    assert grasp_friction(deep, box(), behind_tip_m=(0.0, 0.02))[0] == 0.2


def test_a_pad_meets_what_stands_out_along_its_length():
    gripper = GRIPPERS["robotiq_2f85"]
    deep = grasps([[0, 0, 0.02], [0, 0, 0.045]])  # the ball's widest line is behind the tips, and beyond the pads
    assert pad_friction(deep, sphere(), gripper)[0] <= 0.3
    assert pad_friction(deep, sphere(), gripper)[1] >= 0.3
    assert np.isinf(pad_friction(grasps([[0, 0, -0.05]]), sphere(), gripper)).all()
    assert pad_friction(Grasps.empty(), sphere(), gripper).shape == (0,)


def test_nothing_to_meet_and_nothing_to_judge():
    nowhere = OrientedCloud(np.full((5, 3), np.nan), np.ones((5, 3)))
    assert np.isinf(grasp_friction(grasps([[0, 0, 0]]), nowhere)).all()
    assert np.isinf(grasp_friction(grasps([[0, 0, 0]]), TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))).all()
    assert grasp_friction(Grasps.empty(), box()).shape == (0,)
    assert find_contacts(Grasps.empty(), sphere()).points.shape == (0, 2, 3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: TriangleMesh(np.zeros((4, 2)), np.zeros((1, 3), int)),
        lambda: TriangleMesh(np.zeros((2, 3)), np.array([[0, 1, 2]])),
        lambda: OrientedCloud(np.zeros((4, 3)), np.zeros((3, 3))),
        lambda: OrientedCloud(np.zeros((4, 3)), np.zeros((4, 3)), radius_m=0),
    ],
)
def test_a_broken_surface_is_refused(make):
    with pytest.raises(InputError):
        make()
