"""Antipodal grasps on rendered objects, judged by the true shapes and by a collision test of its own."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from thinkgrasp.checks.collision import CollisionCheck, TableClearanceCheck
from thinkgrasp.checks.force_closure import ForceClosureCheck
from thinkgrasp.checks.workspace import TargetCheck, WidthCheck, WorkspaceCheck
from thinkgrasp.errors import ConfigError
from thinkgrasp.generators.antipodal import AntipodalGenerator, split_objects
from thinkgrasp.geometry import deproject, invert, organised_normals
from thinkgrasp.gripper import Gripper
from thinkgrasp.sim.solids import Paint
from thinkgrasp.sim.tabletop import (
    TableObject,
    TabletopScene,
    ball,
    banana,
    bowl,
    box,
    can,
    cup,
    drill,
    look_at,
    marker,
    mug,
    pose,
    render,
)
from thinkgrasp.types import CameraIntrinsics, Frame, Grasp, Grasps, Proposal, Scene, Segment, SupportPlane

REAL = Path(__file__).parents[3] / "shared" / "real_scenes"
CAMERA = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
EYES = {"slant": (0.0, -0.5, 0.5), "low": (0.0, -0.6, 0.34), "above": (0.0, -0.05, 0.7)}
PAINT = Paint((200, 60, 60))
CHECKS = (
    TargetCheck(),
    WidthCheck(),
    WorkspaceCheck(),
    ForceClosureCheck(),
    CollisionCheck(standoff_m=0.10),
    TableClearanceCheck(margin_m=0.003),
)
GRASPABLE = {
    "marker": marker("marker", PAINT, pose(0, 0, 0, 0.4)),
    "can": can("can", 0.033, 0.10, PAINT, pose(0, 0)),
    "cracker box standing": box("box", (0.16, 0.06, 0.21), PAINT, pose(0, 0, 0, 0.3)),
    "cracker box on its side": box("box", (0.21, 0.06, 0.16), PAINT, pose(0, 0, 0, 1.2)),
    "ball": ball("ball", 0.033, PAINT, pose(0, 0)),
    "bowl": bowl("bowl", 0.082, 0.055, PAINT, pose(0, 0)),
    "mug": mug("mug", 0.041, 0.085, PAINT, pose(0, 0, 0, -0.6)),
    "wide mug": mug("mug", 0.05, 0.10, PAINT, pose(0, 0, 0, -1.6)),
    "cup": cup("cup", 0.03, 0.09, PAINT, pose(0, 0)),
    "banana": banana("banana", pose(0, 0, 0, 0.5)),
    "drill": drill("drill", pose(0, 0, 0, 0.6)),
    "small box": box("box", (0.04, 0.04, 0.04), PAINT, pose(0, 0, 0, 0.6)),
}
TOO_LARGE = {
    "large ball": ball("ball", 0.06, PAINT, pose(0, 0)),
    "large cube": box("box", (0.12, 0.12, 0.12), PAINT, pose(0, 0, 0, 0.5)),
    "cracker box lying": box("box", (0.21, 0.16, 0.06), PAINT, pose(0, 0, 0, 0.3)),
}


def view(objects: tuple[TableObject, ...], eye: tuple[float, float, float], *, plane: bool = True):
    """Render; the support is known exactly, everything else comes from the noisy depth."""
    T = look_at(eye, (0, 0, 0.03))
    rendering = render(TabletopScene(objects), CAMERA, T)
    points = deproject(rendering.frame.depth, CAMERA)
    normal = T[:3, :3].T @ np.array([0, 0, 1.0])
    support = SupportPlane(normal, float(T[2, 3]), rendering.labels < 0, 0.001) if plane else None
    normals = organised_normals(points, CAMERA) if plane else None
    return rendering, Scene(rendering.frame, points, normals, support)


def segment(mask: np.ndarray) -> Segment:
    v, u = np.nonzero(mask)
    return Segment("it", 1.0, mask, (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1), False)


def survivors(scene: Scene, mask: np.ndarray, gripper: Gripper, seed: int = 0) -> Grasps:
    grasps = AntipodalGenerator().generate(scene, mask, gripper, np.random.default_rng(seed))
    for check in CHECKS:
        grasps = grasps[check.keep(scene, segment(mask), grasps, gripper)]
    return grasps


@cache
def on_object(name: str, eye: str, gripper: str):
    rendering, scene = view(((GRASPABLE | TOO_LARGE)[name],), EYES[eye])
    return rendering, scene, survivors(scene, rendering.mask(0), Gripper.load(gripper))


def occupied_voxels(scene: Scene, size_m: float = 0.003) -> np.ndarray:
    points = scene.points[np.isfinite(scene.points[..., 2])].astype(np.float64)
    return (np.unique(np.floor(points / size_m).astype(np.int64), axis=0) + 0.5) * size_m


def voxels_in_bodies(voxels: np.ndarray, grasp: Grasp, gripper: Gripper, standoff_m: float = 0.10) -> int:
    """Count occupied voxels' centres inside any body, at the grasp and every 2 mm on the way there."""
    local = (voxels - grasp.position) @ grasp.rotation
    bodies = gripper.bodies(grasp.width_m)
    low, high = bodies[:, 0].min(axis=0) - np.array([0, 0, standoff_m]), bodies[:, 1].max(axis=0)
    near = local[((local >= low) & (local <= high)).all(axis=1)]
    count = 0
    for back in np.arange(0.0, standoff_m + 1e-9, 0.002):
        moved = near + np.array([0, 0, back])
        for low, high in bodies:
            count += int(((moved > low) & (moved < high)).all(axis=1).sum())
    return count


def lowest_body_height(scene: Scene, grasp: Grasp, gripper: Gripper) -> float:
    corners = np.array(
        [[b[s[k], k] for k in range(3)] for b in gripper.bodies(grasp.width_m) for s in np.ndindex(2, 2, 2)]
    )
    assert scene.support is not None
    return float(scene.support.height(corners @ grasp.rotation.T + grasp.position).min())


def verify(scene: Scene, grasps: Grasps, gripper: Gripper, n: int) -> None:
    voxels = occupied_voxels(scene)
    R = grasps.rotations.astype(np.float64)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    assert (grasps.widths <= gripper.max_width_m + 1e-6).all()
    assert (grasps.widths >= gripper.min_width_m).all()
    assert ((grasps.scores > 0) & (grasps.scores <= 1)).all()
    for i in np.linspace(0, len(grasps) - 1, min(n, len(grasps))).astype(int):
        grasp = grasps.at(int(i))
        assert voxels_in_bodies(voxels, grasp, gripper) == 0
        if scene.support is not None:
            assert lowest_body_height(scene, grasp, gripper) >= 0.003 - 1e-6


def hit(obj: TableObject, T_camera_object: np.ndarray, origin: np.ndarray, direction: np.ndarray):
    """First hit of rays (N, 3) on the true shape: distances (N,) and outward normals (N, 3)."""
    best, normals = np.full(len(origin), np.inf), np.zeros((len(origin), 3))
    for solid in obj.solids:
        T = T_camera_object @ solid.T_object_solid
        to = invert(T)
        o, d = origin @ to[:3, :3].T + to[:3, 3], direction @ to[:3, :3].T
        t = solid.distances(o, d)
        surface = np.argmin(t, axis=0)
        t = t.min(axis=0)
        nearer = t < best
        if nearer.any():
            best[nearer] = t[nearer]
            at = o[nearer] + t[nearer, None] * d[nearer]
            normals[nearer] = solid.normals(at, surface[nearer]) @ T[:3, :3].T
    return best, normals


def true_contact_angle(obj: TableObject, T_world_camera: np.ndarray, grasp: Grasp, gripper: Gripper) -> float:
    """Larger angle [rad] between the closing direction and the true surface where the pads first touch it."""
    T = invert(T_world_camera) @ obj.T_world_object
    breadth = gripper.finger_breadth_m / 2
    y, z = (
        a.ravel() for a in np.meshgrid(np.linspace(-breadth, breadth, 7), np.linspace(-gripper.pad_length_m, 0, 12))
    )
    x_axis, y_axis, z_axis = grasp.rotation.T
    worst = 0.0
    for side in (-1, 1):
        origin = grasp.position + side * grasp.width_m / 2 * x_axis + y[:, None] * y_axis + z[:, None] * z_axis
        t, normals = hit(obj, T, origin, np.repeat(-side * x_axis[None], len(origin), axis=0))
        if t.min() > grasp.width_m:
            return np.pi
        normal = normals[t < t.min() + 0.0007].mean(axis=0)
        worst = max(worst, float(np.arccos(np.clip(side * normal @ x_axis / np.linalg.norm(normal), -1, 1))))
    return worst


VIEWS = [(name, "slant") for name in GRASPABLE]
VIEWS += [(name, "low") for name in ("can", "bowl", "mug", "banana", "cracker box standing")]
VIEWS += [(name, "above") for name in ("marker", "cup", "drill", "cracker box on its side")]


@pytest.mark.parametrize(("name", "eye"), VIEWS)
def test_finds_collision_free_grasps(name, eye):
    _, scene, grasps = on_object(name, eye, "robotiq_2f85")
    assert len(grasps) >= 20
    verify(scene, grasps, Gripper.load("robotiq_2f85"), 8)


@pytest.mark.parametrize("name", ["marker", "can", "bowl", "mug", "cracker box standing", "banana"])
def test_works_for_the_franka_hand(name):
    _, scene, grasps = on_object(name, "slant", "franka_hand")
    assert len(grasps) >= 20
    verify(scene, grasps, Gripper.load("franka_hand"), 8)


@pytest.mark.parametrize("eye", ["slant", "above"])
@pytest.mark.parametrize("name", TOO_LARGE)
def test_says_no_where_no_grasp_is_possible(name, eye):
    assert len(on_object(name, eye, "robotiq_2f85")[2]) == 0


@pytest.mark.parametrize(("name", "eye"), VIEWS)
def test_true_contacts_of_the_best_grasps_are_antipodal(name, eye):
    rendering, _, grasps = on_object(name, eye, "robotiq_2f85")
    gripper = Gripper.load("robotiq_2f85")
    T = rendering.frame.T_world_camera
    angles = np.array([true_contact_angle(GRASPABLE[name], T, g, gripper) for g in grasps[:20]])
    assert (angles < np.arctan(1.0)).mean() >= 0.9
    assert (angles < np.deg2rad(30)).mean() >= 0.75


def test_grasps_come_from_above_and_scores_are_sorted():
    _, scene, _ = on_object("can", "slant", "robotiq_2f85")
    rendering, _, _ = on_object("can", "slant", "robotiq_2f85")
    grasps = AntipodalGenerator(max_tilt_deg=40).generate(
        scene, rendering.mask(0), Gripper.load("robotiq_2f85"), np.random.default_rng(0)
    )
    assert len(grasps) > 100
    assert (np.diff(grasps.scores) <= 0).all()
    down = -(grasps.rotations[:, :, 2] @ scene.support.normal)
    assert (down >= np.cos(np.deg2rad(40)) - 1e-4).all()


def test_same_seed_same_grasps():
    rendering, scene, first = on_object("mug", "slant", "robotiq_2f85")
    again = survivors(scene, rendering.mask(0), Gripper.load("robotiq_2f85"))
    other = survivors(scene, rendering.mask(0), Gripper.load("robotiq_2f85"), seed=1)
    for field in ("rotations", "positions", "widths", "scores"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert len(other) != len(first) or not np.array_equal(other.positions, first.positions)


@pytest.mark.parametrize("name", ["can", "banana", "small box"])
def test_works_without_support_and_normals(name):
    rendering, scene = view((GRASPABLE[name],), EYES["slant"], plane=False)
    grasps = survivors(scene, rendering.mask(0), Gripper.load("robotiq_2f85"))
    assert len(grasps) >= 5
    verify(scene, grasps, Gripper.load("robotiq_2f85"), 8)


def test_neighbours_are_avoided_and_only_the_target_is_grasped():
    objects = (
        can("can", 0.033, 0.10, PAINT, pose(0, 0)),
        box("box", (0.05, 0.05, 0.09), PAINT, pose(0.075, 0.01, 0, 0.2)),
        mug("mug", 0.04, 0.085, PAINT, pose(-0.10, 0.03, 0, 2.0)),
    )
    rendering, scene = view(objects, EYES["slant"])
    gripper = Gripper.load("robotiq_2f85")
    scene = Scene(scene.frame, scene.points, scene.normals, scene.support, None, proposals(rendering))
    crop = rendering.mask(0) | rendering.mask(1)
    grasps = AntipodalGenerator().generate(scene, crop, gripper, np.random.default_rng(0))
    on: list[int] = []
    for i in (0, 1):
        kept = grasps
        for check in CHECKS:
            kept = kept[check.keep(scene, segment(rendering.mask(i)), kept, gripper)]
        verify(scene, kept, gripper, 8)
        on.append(len(kept))
    assert min(on) >= 10


def proposals(rendering) -> tuple[Proposal, ...]:
    """True masks as proposals; the generator reads nothing else of them."""
    found = []
    for i in range(int(rendering.labels.max()) + 1):
        s = segment(rendering.mask(i))
        found.append(Proposal(i + 1, s.mask, s.box_xyxy, (0.1, 0.1, 0.1), np.eye(4), (0.0, 0.1), (), (), False, 1.0))
    return tuple(found)


def test_objects_under_the_crop_are_taken_apart():
    rendering, scene = view((GRASPABLE["can"], box("b", (0.05, 0.05, 0.05), PAINT, pose(0.15, 0))), EYES["slant"])
    a, b = rendering.mask(0), rendering.mask(1)
    named = Scene(scene.frame, scene.points, proposals=proposals(rendering))
    assert [m.sum() for m in split_objects(named, a | b)] == [a.sum(), b.sum()]
    assert [m.sum() for m in split_objects(scene, a | b)] == [(a | b).sum()], "without proposals the crop is one thing"
    part = a.copy()
    part[: np.flatnonzero(a.any(axis=1))[0] + 25] &= True
    part[np.flatnonzero(a.any(axis=1))[0] + 25 :] = False
    assert split_objects(named, part)[0].sum() == a.sum(), "a part is completed with the whole it belongs to"
    assert split_objects(named, np.zeros_like(a)) == []


def test_a_part_is_grasped_at_the_part():
    rendering, scene = view((GRASPABLE["mug"],), EYES["slant"])
    mask = rendering.mask(0)
    scene = Scene(scene.frame, scene.points, scene.normals, scene.support, None, proposals(rendering))
    columns = np.flatnonzero(mask.any(axis=0))
    left = mask.copy()
    left[:, columns[0] + len(columns) // 3 :] = False
    grasps = survivors(scene, left, Gripper.load("robotiq_2f85"))
    assert len(grasps) >= 5
    pixel = CAMERA.project(grasps.positions.astype(np.float64))
    assert (pixel[:, 0] <= columns[0] + len(columns) // 3 + 1).all()


@pytest.mark.parametrize("kind", ["empty", "one pixel", "no depth", "bare table"])
def test_crops_without_an_object_give_no_grasps(kind):
    rendering, scene = view((GRASPABLE["can"],), EYES["slant"])
    crop = np.zeros((480, 640), bool)
    points = scene.points
    if kind == "one pixel":
        crop[240, 320] = True
    elif kind == "no depth":
        crop = rendering.mask(0)
        points = np.full_like(points, np.nan)
    elif kind == "bare table":
        crop[400:440, 100:160] = True
    frame = Frame(scene.frame.color, scene.frame.depth, CAMERA)
    bare = Scene(frame, points, scene.normals, scene.support)
    assert len(AntipodalGenerator().generate(bare, crop, Gripper.load("robotiq_2f85"), np.random.default_rng(0))) == 0


@pytest.mark.parametrize(
    "settings", [{"max_grasps": 0}, {"voxel_m": -1}, {"min_clearance_m": 0.02}, {"n_lines": np.nan}]
)
def test_settings_out_of_range(settings):
    with pytest.raises(ConfigError, match="antipodal generator"):
        AntipodalGenerator(**settings)


@pytest.mark.skipif(not REAL.is_dir(), reason="real_scenes is not beside this checkout")
@pytest.mark.parametrize("name", ["000000", "000004"])
def test_every_grasp_on_real_frames_is_clear(name):
    from thinkgrasp.cameras.files import load_frame
    from thinkgrasp.perception import GeometricPerception

    scene = GeometricPerception().perceive(
        load_frame(REAL / f"{name}-color.png", REAL / f"{name}-depth.png", REAL / "camera_params.json")
    )
    gripper = Gripper.load("robotiq_2f85")
    boxes = [
        i["target_xyxy"][0] for i in json.loads((REAL / "annotations.json").read_text())["scenes"][name]["instructions"]
    ]
    graspable = 0
    for x0, y0, x1, y1 in boxes:
        centre = ((x0 + x1) / 2, (y0 + y1) / 2)
        nearest = min(
            scene.proposals,
            key=lambda p: np.hypot(
                (p.box_xyxy[0] + p.box_xyxy[2]) / 2 - centre[0], (p.box_xyxy[1] + p.box_xyxy[3]) / 2 - centre[1]
            ),
        )
        grasps = survivors(scene, nearest.mask, gripper)
        graspable += len(grasps) > 0
        if len(grasps):
            verify(scene, grasps, gripper, 3)
    assert graspable >= 0.7 * len(boxes)
