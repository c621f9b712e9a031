"""What other cameras saw of a thing: it is told from its neighbours, and grasps are proposed on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fakes.tables import RED, view
from fakes.two_views import BACK, BOX_M, FRONT, frames, scene, thing

from thinkgrasp.fusion import fuse
from thinkgrasp.generators.antipodal import AntipodalGenerator
from thinkgrasp.generators.other_views import own_points, owners
from thinkgrasp.generators.surface import Completed, seen_surface
from thinkgrasp.geometry import apply
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Proposal, Scene

GRIPPER = GRIPPERS["robotiq_2f85"]


def owned(scene: Scene, proposal: Proposal) -> np.ndarray:
    """World coordinates of the other view's points that belong to a proposal."""
    assert scene.frame.others is not None
    assert scene.frame.T_world_camera is not None
    return apply(scene.frame.T_world_camera, scene.frame.others.points[own_points(scene, proposal.mask)])


def test_a_thing_keeps_its_back_and_not_what_touches_it():
    box = owned(scene(), thing(scene(), "red"))
    assert len(box) > 100
    assert (box[:, 1] < BOX_M[1] / 2 + 0.006).mean() > 0.97, "the blue box behind is not its own"
    assert (np.abs(box[:, 1] - BOX_M[1] / 2) < 0.004).mean() > 0.8
    can = owned(scene(), thing(scene(), "green"))
    assert len(can) > 50
    assert (np.abs(np.hypot(can[:, 0] - 0.10, can[:, 1]) - 0.03) < 0.004).mean() > 0.9


def test_nothing_of_the_support_belongs_to_a_thing():
    others, support = scene().frame.others, scene().support
    assert others is not None
    assert support is not None
    assert support.height(others.points[owners(scene()) > 0]).min() > 0.004


def test_a_mask_that_is_no_proposal_owns_nothing():
    mask = thing(scene(), "red").mask.copy()
    assert len(own_points(scene(), mask)) == 0
    assert len(own_points(GeometricPerception().perceive(frames()[0]), mask)) == 0


def test_points_of_a_view_that_disagrees_belong_to_nothing():
    front, back = frames()
    assert back.T_world_camera is not None
    wrong = back.T_world_camera.copy()
    wrong[2, 3] += 0.015
    fused = fuse([front, replace(back, T_world_camera=wrong)])
    found = GeometricPerception().perceive(fused)
    assert not owners(found).any()
    assert len(own_points(found, thing(found, "red").mask)) == 0


def test_the_seen_surface_goes_round_the_thing():
    alone, fused = GeometricPerception().perceive(frames()[0]), scene()
    depths = []
    for s in (alone, fused):
        box = thing(s, "red").mask
        surface = seen_surface(s, box, box, 700, 0.003)
        assert surface is not None
        assert surface.seen.all()
        assert surface.wanted.all()
        assert s.frame.T_world_camera is not None
        depths.append(np.ptp(apply(s.frame.T_world_camera, surface.points)[:, 1]))
    assert depths[1] == pytest.approx(BOX_M[1], abs=0.006)


def test_of_a_part_only_what_is_next_to_it_is_wanted():
    box = thing(scene(), "red").mask
    crop = box.copy()
    crop[:, : int(np.flatnonzero(box.any(axis=0)).mean())] = False
    surface = seen_surface(scene(), box, crop, 700, 0.003)
    assert surface is not None
    x = apply(scene().frame.T_world_camera, surface.points)[:, 0]  # type: ignore[arg-type]
    assert x[surface.wanted].mean() > x[~surface.wanted].mean() + 0.03


def test_what_is_inferred_stays_out_of_space_that_another_camera_saw_through():
    """Seen from the front alone, a low wedge may be as deep as its shadow; from behind it is seen that it is not."""
    things = (t.box("plate", (0.12, 0.012, 0.10), RED, t.pose(0.0, 0.0)),)
    front, back = (view(*things, eye=eye, size=(320, 240), noise=False).frame for eye in (FRONT, BACK))
    found = GeometricPerception().perceive(fuse([front, back]))
    mask = thing(found, "red").mask
    completed = Completed.of(found, mask, mask, max_points=700, voxel_m=0.003)
    assert completed is not None
    inferred = completed.whole.points[~completed.whole.seen]
    world = apply(found.frame.T_world_camera, inferred)  # type: ignore[arg-type]
    assert (world[:, 1] < 0.006 + 0.012).all()


def test_grasps_are_proposed_between_front_and_back():
    found, box = scene(), thing(scene(), "red")
    grasps = AntipodalGenerator().generate(found, box.mask, GRIPPER, np.random.default_rng(0))
    assert len(grasps) > 20
    assert found.frame.T_world_camera is not None
    closing = np.abs(grasps.rotations[:, :, 0] @ found.frame.T_world_camera[1, :3])
    across = grasps.positions[closing > 0.95]
    y = apply(found.frame.T_world_camera, across)[:, 1]
    assert np.abs(np.median(y)) < 0.004, "centred on the box, not on a guess of its depth"


def test_one_view_is_what_it_was():
    """A frame that is not fused gives the same grasps every time, and owns nothing more."""
    front = frames()[0]
    perceived = GeometricPerception().perceive(front)
    box = thing(perceived, "red").mask
    a, b = (AntipodalGenerator().generate(perceived, box, GRIPPER, np.random.default_rng(0)) for _ in range(2))
    assert np.array_equal(a.positions, b.positions)
    assert owners(perceived).shape == (0,)
