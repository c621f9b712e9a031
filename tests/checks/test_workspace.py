import numpy as np
import pytest

from thinkgrasp.checks.workspace import TargetCheck, WidthCheck, WorkspaceCheck
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import CameraIntrinsics, Frame, Grasps, Scene, Segment, SupportPlane

GRIPPER = Gripper.load("robotiq_2f85")
CAMERA = CameraIntrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)


def scene(workspace=None) -> Scene:
    """The camera looks straight down on a support 0.8 m away."""
    depth = np.full((48, 64), 0.8, np.float32)
    v, u = np.mgrid[0:48, 0:64].astype(np.float32)
    points = np.stack([(u - 31.5) / 60 * depth, (v - 23.5) / 60 * depth, depth], -1)
    support = SupportPlane(np.array([0.0, 0, -1]), 0.8, np.ones((48, 64), bool), 0.0)
    return Scene(Frame(np.zeros((48, 64, 3), np.uint8), depth, CAMERA, workspace=workspace), points, support=support)


def grasps(*positions, approach=(0, 0, 1), width=0.05) -> Grasps:
    z = np.asarray(approach, np.float64)
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    n = len(positions)
    R = np.stack([x, np.cross(z, x), z], -1).astype(np.float32)
    return Grasps(
        np.repeat(R[None], n, 0), np.array(positions, np.float32), np.full(n, width, np.float32), np.ones(n, np.float32)
    )


def at_pixel(u: float, v: float, z: float) -> tuple[float, float, float]:
    return ((u - 31.5) / 60 * z, (v - 23.5) / 60 * z, z)


def target() -> Segment:
    """An L of pixels in the box 10..30 x 10..40: its lower right is empty."""
    mask = np.zeros((48, 64), bool)
    mask[10:30, 10:14] = True
    mask[10:13, 10:40] = True
    return Segment("L", 1.0, mask, (10, 10, 40, 30), False)


def test_target_check_wants_the_tcp_on_the_mask_inside_the_box_at_its_depth():
    on_mask, gap, outside = at_pixel(12, 20, 0.79), at_pixel(35, 26, 0.79), at_pixel(5, 20, 0.79)
    before, behind = at_pixel(12, 20, 0.6), at_pixel(12, 20, 0.95)
    batch = grasps(on_mask, gap, outside, before, behind)
    kept = TargetCheck(max_distance_px=4).keep(scene(), target(), batch, GRIPPER)
    assert kept.tolist() == [True, False, False, False, False]
    assert TargetCheck(max_distance_px=30).keep(scene(), target(), batch, GRIPPER).tolist()[:3] == [True, True, False]


def test_target_check_drops_what_is_behind_the_camera():
    assert not TargetCheck().keep(scene(), target(), grasps((0, 0, -0.5), (0, 0, 0)), GRIPPER).any()


def test_width_check_takes_the_grippers_range():
    narrow = Gripper("n", 0.08, 0.05, 0.01, 0.02, (0.1, 0.06, 0.05), 0.03, min_width_m=0.01)
    widths = [0.005, 0.0101, 0.05, 0.0799, 0.081]
    kept = [WidthCheck().keep(scene(), target(), grasps((0, 0, 0.7), width=w), narrow)[0] for w in widths]
    assert kept == [False, True, True, True, False]


def test_workspace_check_height_distance_and_image():
    batch = grasps((0, 0, 0.78), (0, 0, 0.81), (0, 0, 0.05), at_pixel(-5, 20, 0.78))
    assert WorkspaceCheck().keep(scene(), target(), batch, GRIPPER).tolist() == [True, False, False, False]
    assert not WorkspaceCheck(max_height_m=0.1).keep(scene(), target(), grasps((0, 0, 0.6)), GRIPPER)[0]
    assert not WorkspaceCheck(max_distance_m=0.7).keep(scene(), target(), grasps((0, 0, 0.78)), GRIPPER)[0]


def test_workspace_check_drops_approaches_from_below():
    for degrees, expected in ((0, True), (80, True), (120, False), (175, False)):
        a = np.deg2rad(degrees)
        batch = grasps((0, 0, 0.7), approach=(np.sin(a), 0, np.cos(a)))
        assert WorkspaceCheck().keep(scene(), target(), batch, GRIPPER)[0] == expected, degrees


def test_workspace_check_honours_the_mask():
    allowed = np.zeros((48, 64), bool)
    allowed[:, :32] = True
    batch = grasps(at_pixel(10, 20, 0.75), at_pixel(50, 20, 0.75))
    assert WorkspaceCheck().keep(scene(allowed), target(), batch, GRIPPER).tolist() == [True, False]


@pytest.mark.parametrize("check", [TargetCheck(), WidthCheck(), WorkspaceCheck()])
def test_no_grasps(check):
    kept = check.keep(scene(), target(), Grasps.empty(), GRIPPER)
    assert kept.shape == (0,)
    assert kept.dtype == np.bool_


@pytest.mark.parametrize(
    ("check", "settings"),
    [
        (TargetCheck, {"max_distance_px": -1}),
        (TargetCheck, {"behind_m": np.nan}),
        (WorkspaceCheck, {"min_distance_m": 3}),
        (WorkspaceCheck, {"max_tilt_deg": 0}),
    ],
)
def test_settings_out_of_range(check, settings):
    with pytest.raises(ConfigError, match="check"):
        check(**settings)
