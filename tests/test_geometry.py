"""Group axioms, round trips and estimators, over random transforms, cameras and clouds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import (
    apply,
    deproject,
    fit_plane,
    invert,
    make_transform,
    quat_wxyz,
    rotation_aligning,
    rotation_from_quat_wxyz,
    voxel_downsample,
)
from thinkgrasp.types import CameraIntrinsics

unit_vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3)
unit_vectors = unit_vectors.map(lambda v: v / np.linalg.norm(v))
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3)
rotations = quaternions.map(rotation_from_quat_wxyz)
translations = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
transforms = st.builds(make_transform, rotations, translations)
clouds = st.integers(0, 2**32 - 1).map(lambda s: np.random.default_rng(s).uniform(-2, 2, (30, 3)))


class TestRigidTransforms:
    @given(transforms, transforms, transforms)
    def test_product_is_associative_and_stays_rigid(self, a, b, c):
        assert np.allclose((a @ b) @ c, a @ (b @ c))
        R = (a @ b @ c)[:3, :3]
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1)

    @given(transforms)
    def test_inverse(self, a):
        assert np.allclose(a @ invert(a), np.eye(4))
        assert np.allclose(invert(a) @ a, np.eye(4))
        assert np.allclose(invert(invert(a)), a)

    @given(transforms, transforms, clouds)
    def test_apply_is_an_action_of_the_group(self, a, b, points):
        assert np.allclose(apply(a @ b, points), apply(a, apply(b, points)))
        assert np.array_equal(apply(np.eye(4), points), points)

    @given(transforms, clouds)
    def test_apply_keeps_distances_shape_and_dtype(self, a, points):
        moved = apply(a, points.reshape(5, 6, 3))
        assert moved.shape == (5, 6, 3)
        assert np.allclose(
            np.linalg.norm(np.diff(moved.reshape(-1, 3), axis=0), axis=1),
            np.linalg.norm(np.diff(points, axis=0), axis=1),
        )
        assert apply(a, points.astype(np.float32)).dtype == np.float32

    def test_make_transform_copies(self):
        R, t = np.eye(3), np.zeros(3)
        T = make_transform(R, t)
        R[0, 0] = t[0] = 9
        assert np.array_equal(T, np.eye(4))


class TestQuaternions:
    @given(rotations)
    def test_round_trip_from_rotation(self, R):
        q = quat_wxyz(R)
        assert np.linalg.norm(q) == pytest.approx(1)
        assert q[0] >= 0
        assert np.allclose(rotation_from_quat_wxyz(q), R, atol=1e-9)

    @given(quaternions, st.floats(0.01, 100), st.booleans())
    def test_scale_and_sign_do_not_matter(self, q, scale, negative):
        other = q * scale * (-1 if negative else 1)
        assert np.allclose(rotation_from_quat_wxyz(other), rotation_from_quat_wxyz(q))

    @given(quaternions)
    def test_agrees_with_scipy(self, q):
        w, x, y, z = q / np.linalg.norm(q)
        assert np.allclose(rotation_from_quat_wxyz(q), Rotation.from_quat([x, y, z, w]).as_matrix())

    @pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0], [0, 0.6, -0.8]]]))
    def test_half_turns(self, axis):
        R = Rotation.from_rotvec(np.pi * axis).as_matrix()
        assert np.allclose(rotation_from_quat_wxyz(quat_wxyz(R)), R)

    @given(rotations, rotations)
    def test_product_of_rotations_is_product_of_quaternions(self, a, b):
        (w1, *v1), (w2, *v2) = quat_wxyz(a), quat_wxyz(b)
        v1, v2 = np.array(v1), np.array(v2)
        product = np.array([w1 * w2 - v1 @ v2, *(w1 * v2 + w2 * v1 + np.cross(v1, v2))])
        assert abs(product @ quat_wxyz(a @ b)) == pytest.approx(1)


@given(unit_vectors, unit_vectors)
def test_rotation_aligning(a, b):
    R = rotation_aligning(a, b)
    assert np.allclose(R @ a, b, atol=1e-6)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-6)


@given(unit_vectors)
def test_rotation_aligning_opposite_vectors(a):
    R = rotation_aligning(a, -a)
    assert np.allclose(R @ a, -a)
    assert np.linalg.det(R) == pytest.approx(1)


cameras = st.builds(
    lambda w, h, fx, fy, x, y: CameraIntrinsics(w, h, fx, fy, x * (w - 1), y * (h - 1)),
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(20, 800),
    st.floats(20, 800),
    st.floats(0, 1),
    st.floats(0, 1),
)


class TestDeprojection:
    @given(cameras, st.integers(0, 2**32 - 1))
    def test_projection_undoes_it(self, camera, seed):
        rng = np.random.default_rng(seed)
        depth = rng.uniform(0.2, 3, (camera.height, camera.width)).astype(np.float32)
        uv = camera.project(deproject(depth, camera))
        v, u = np.mgrid[: camera.height, : camera.width]
        assert np.allclose(uv[..., 0], u, atol=1e-3)
        assert np.allclose(uv[..., 1], v, atol=1e-3)

    @given(cameras)
    def test_depth_is_z_and_no_return_is_nan(self, camera):
        depth = np.full((camera.height, camera.width), 0.7, np.float32)
        depth[0, 0] = 0
        points = deproject(depth, camera)
        assert points.dtype == np.float32
        assert np.isnan(points[0, 0]).all()
        assert np.array_equal(points[..., 2].ravel()[1:], depth.ravel()[1:])

    def test_nan_depth_is_nan(self):
        points = deproject(np.full((2, 3), np.nan, np.float32), CameraIntrinsics(3, 2, 10, 10, 1, 1))
        assert np.isnan(points).all()

    def test_axes(self):
        points = deproject(np.ones((3, 3), np.float32), CameraIntrinsics(3, 3, 1.0, 1.0, 1.0, 1.0))
        assert np.array_equal(points[1, 2], [1, 0, 1])  # right of the centre: +x
        assert np.array_equal(points[2, 1], [0, 1, 1])  # below the centre: +y

    def test_size_mismatch(self):
        with pytest.raises(InputError, match=r"\(3, 2\) but the camera is 4x2"):
            deproject(np.ones((2, 3), np.float32), CameraIntrinsics(4, 2, 10, 10, 1, 1))


class TestPlane:
    @given(unit_vectors, st.floats(0.1, 3), st.integers(0, 2**32 - 1))
    def test_exact_points(self, normal, offset, seed):
        rng = np.random.default_rng(seed)
        frame = rotation_aligning(np.array([0.0, 0, 1]), normal)
        points = rng.uniform(-1, 1, (40, 2)) @ frame[:, :2].T - offset * normal
        found, d = fit_plane(points)
        assert np.allclose(found, normal, atol=1e-6)
        assert d == pytest.approx(offset, abs=1e-6)

    @given(st.integers(0, 2**32 - 1))
    def test_noise_moves_it_little(self, seed):
        rng = np.random.default_rng(seed)
        points = np.c_[rng.uniform(-0.5, 0.5, (400, 2)), 1 + rng.normal(0, 0.002, 400)]
        normal, offset = fit_plane(points)
        assert normal[2] < -0.999
        assert offset == pytest.approx(1, abs=0.002)


class TestVoxels:
    @given(clouds, st.floats(0.05, 1))
    def test_one_point_per_occupied_voxel(self, points, voxel):
        kept = voxel_downsample(points, voxel)
        keys = np.floor((points - points.min(axis=0)) / voxel).astype(int)
        assert len(kept) == len(np.unique(keys, axis=0)) == len(np.unique(keys[kept], axis=0))
        assert np.array_equal(kept, np.sort(kept))

    def test_none(self):
        assert voxel_downsample(np.zeros((0, 3)), 0.1).shape == (0,)
