"""What can be taken, what is in the way, and the fewest grasps, on piles small enough to know the answer."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from thinkgrasp.benchmark.fewest_steps import Fewest, fewest_steps
from thinkgrasp.benchmark.reachability import Judgement, Reachability, toppled
from thinkgrasp.benchmark.true_grasps import ConvexPieces, corners, grasps_on, surface_points
from thinkgrasp.closure import TriangleMesh, find_contacts
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.geometry import make_transform
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.motion.cell import BIN
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.objects import CollisionPiece, SimObject, VisualPiece
from thinkgrasp.sim.scenes import PiledScene, SceneSpec
from thinkgrasp.sim.views import default_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Grasps

GRIPPER = GRIPPERS["robotiq_2f85"]
MIDDLE = (0.5, 0.0)
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32,
)  # fmt: skip


@pytest.fixture(scope="module")
def motion() -> ArmMotion:
    return ArmMotion()


def block(name: str, *sides: float) -> SimObject:
    half = np.array(sides) / 2
    vertices = (np.array(list(product((-1, 1), repeat=3))) * half).astype(np.float32)
    return SimObject(
        name, "block", ("red",), (), 0.1, 0.6,
        (VisualPiece("body", vertices, FACES, (0.8, 0.2, 0.2)),),
        (CollisionPiece("box", (float(half[0]), float(half[1]), float(half[2]))),),
    )  # fmt: skip


def placed(*things: tuple[SimObject, Sequence[float]]) -> World:
    """Objects, boxes by their middle's x and y and their lower side's height, in a world without the arm."""
    world = World([obj for obj, _ in things], robot=False)
    for index, (obj, (x, y, z)) in enumerate(things):
        world.place(index, make_transform(np.eye(3), np.array([x, y, z - obj.bounds_m[0, 2]])))
    return world


def piled(world: World, *goals: int) -> PiledScene:
    spec = SceneSpec("take the cube", world.objects, goals, world.poses(), 0, None)
    return PiledScene(spec, world.poses(), tuple(1.0 for _ in goals), 1)


CUBE = block("cube", 0.05, 0.05, 0.05)
LID = SimObject(
    "lid", "block", ("red",), (), 0.1, 0.6,
    block("slab", 0.22, 0.22, 0.01).visuals,
    (CollisionPiece("box", (0.11, 0.11, 0.005)), CollisionPiece("box", (0.015, 0.015, 0.025), (0.0, 0.0, 0.03))),
)  # fmt: skip
"""Too wide to be taken but by its knob."""
WALL = block("wall", 0.16, 0.04, 0.06)
POST = block("post", 0.04, 0.04, 0.06)


def test_a_lone_cube_can_be_taken(motion):
    truth = Reachability(placed((CUBE, (*MIDDLE, 0))), [0], motion=motion)
    assert truth.takeable(0)
    assert truth.obstructions(0) == truth.blockers(0) == frozenset()
    assert truth.judge(0) == Judgement(right=True, chance=1.0, goal_takeable=True)
    assert not truth.judge(None).right


@pytest.mark.parametrize(
    ("xyz", "sides"),
    [
        pytest.param((1.03, -0.5, 0), (0.05, 0.05, 0.05), id="beyond the arm's reach"),
        pytest.param((*MIDDLE, 0), (0.12, 0.12, 0.03), id="too wide for the gripper"),
        pytest.param((*MIDDLE, 0), (0.04, 0.04, 0.003), id="too flat for the fingers"),
    ],
)
def test_what_no_grasp_reaches(motion, xyz, sides):
    truth = Reachability(placed((block("thing", *sides), xyz)), [0], motion=motion)
    assert not truth.takeable(0)
    assert truth.right_choices() == frozenset()
    assert truth.judge(0) == Judgement(right=False, chance=0.0, goal_takeable=False)


def test_what_lies_on_top_is_the_obstruction(motion):
    world = placed((CUBE, (*MIDDLE, 0)), (LID, (*MIDDLE, 0.05)), (POST, (0.5, 0.17, 0)))
    truth = Reachability(world, [0], motion=motion)
    assert not truth.takeable(0)
    assert truth.takeable(1)
    assert truth.obstructions(0) == {1}
    assert truth.judge(1).right
    assert not truth.judge(2).right
    assert truth.judge(2).chance == pytest.approx(1 / 3)


def test_a_step_towards_a_blocker_is_a_true_step(motion):
    """A lid on a cube, and a second one on its knob: the lower one is in the cube's way, the upper one in the lid's."""
    world = placed((CUBE, (*MIDDLE, 0)), (LID, (*MIDDLE, 0.05)), (LID, (*MIDDLE, 0.11)))
    truth = Reachability(world, [0], motion=motion)
    assert truth.blockers(1) == {2}
    assert truth.obstructions(0) == {1, 2}
    assert truth.judge(2).right
    assert fewest_steps(piled(world, 0)) == Fewest(3, True, (2, 1, 0), 3)


def test_walls_on_all_sides(motion):
    """A cube walled in: either pair of opposite walls lets the fingers in, one wall of a pair alone does not."""
    beside = 0.025 + 0.02 + 0.002
    cross = block("cross", 0.04, 0.05, 0.06)
    world = placed(
        (CUBE, (*MIDDLE, 0)),
        (WALL, (0.5, beside, 0)),
        (WALL, (0.5, -beside, 0)),
        (cross, (0.5 + beside, 0, 0)),
        (cross, (0.5 - beside, 0, 0)),
    )
    truth = Reachability(world, [0], motion=motion)
    assert not truth.takeable(0)
    assert truth.obstructions(0) == {1, 2, 3, 4}
    assert truth.blocking_size(0) == 2
    found = fewest_steps(piled(world, 0))
    assert (found.steps, found.exact, found.order[-1]) == (3, True, 0)


def test_two_walls_leave_the_other_way(motion):
    world = placed((CUBE, (*MIDDLE, 0)), (WALL, (0.5, 0.047, 0)), (WALL, (0.5, -0.047, 0)))
    assert Reachability(world, [0], motion=motion).takeable(0)


def test_refresh_takes_the_world_as_it_is_now(motion):
    world = placed((CUBE, (*MIDDLE, 0)), (LID, (*MIDDLE, 0.05)))
    truth = Reachability(world, [0], motion=motion)
    assert not truth.takeable(0)
    world.park(1)
    assert not truth.takeable(0)
    truth.refresh()
    assert truth.takeable(0)
    assert truth.in_view() == (0,)


def test_what_hides_a_goal_counts_only_while_no_goal_is_in_view(motion):
    """A screen towards the camera hides a cube that fingers reach well: both are right, until the cube is seen."""
    screen = block("screen", 0.02, 0.20, 0.24)
    world = placed((CUBE, (0.45, 0, 0)), (screen, (0.56, 0, 0)), (POST, (0.45, 0.17, 0)))
    hidden = Reachability(world, [0], [default_view(size_wh=(224, 224))], motion=motion)
    assert 0 not in hidden.in_view()
    assert 1 in hidden.right_choices()
    assert 1 in hidden.obstructions(0)
    seen = Reachability(world, [0], motion=motion)
    assert 1 not in seen.right_choices() or not seen.takeable(0)


def test_the_right_choice_is_any_goal_that_can_be_taken(motion):
    world = placed((CUBE, (*MIDDLE, 0)), (LID, (*MIDDLE, 0.05)), (CUBE, (0.5, 0.15, 0)), (POST, (0.5, -0.15, 0)))
    truth = Reachability(world, [0, 2], motion=motion)
    assert truth.right_choices() == {2}
    assert truth.chance() == 1 / 4


@pytest.mark.parametrize("goals", [[], [1], [-1]])
def test_goals_are_checked(goals):
    with pytest.raises(InputError, match=r"objects 0\.\.0"):
        Reachability(placed((CUBE, (*MIDDLE, 0))), goals)


def test_fewest_steps_of_what_nobody_can_take(motion):
    world = placed((block("slab", 0.12, 0.12, 0.03), (*MIDDLE, 0)))
    assert fewest_steps(piled(world, 0)) == Fewest(None, False, (), 1)
    assert str(fewest_steps(piled(world, 0))) == "unknown"


def test_fewest_steps_cut_off_says_so():
    world = placed((CUBE, (*MIDDLE, 0)), (LID, (*MIDDLE, 0.05)))
    assert fewest_steps(piled(world, 0)) == Fewest(2, True, (1, 0), 2)
    assert fewest_steps(piled(world, 0), limit=1).steps is None
    with pytest.raises(ConfigError, match="limit"):
        fewest_steps(piled(world, 0), limit=0)


def test_bounds_print_as_such():
    assert str(Fewest(4, False, (1, 2, 3, 0), 60)) == "at most 4"


def test_toppled():
    before = np.tile(np.eye(4), (6, 1, 1))
    before[:, :3, 3] = (*MIDDLE, 0.05)
    after = before.copy()
    over = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    about_up = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float)
    after[1:, :3, :3] = over
    after[5, :3, :3] = about_up
    after[2, :3, 3] = (*MIDDLE, -0.7)
    after[3, :3, 3] = (np.mean(BIN.x_m), np.mean(BIN.y_m), 0.05)
    assert toppled(before, after, moved_by={4}) == (1,)


@pytest.mark.parametrize("name", ["mug", "pear"])
def test_grasps_close_on_the_surface(name):
    """Where the fingers of a grasp close, they meet the object, at contacts as far apart as the opening allows."""
    obj = catalogue.make(name)
    grasps = grasps_on(obj, GRIPPER)
    assert len(grasps) > 50
    assert grasps is grasps_on(obj, GRIPPER)
    assert (grasps.widths <= GRIPPER.max_width_m + 1e-9).all()
    np.testing.assert_allclose(np.linalg.det(grasps.rotations), 1, atol=1e-6)
    triangles = np.concatenate(ConvexPieces.of(obj.collisions).triangles).reshape(-1, 3)
    surface = TriangleMesh(triangles, np.arange(len(triangles)).reshape(-1, 3))
    some = grasps[np.arange(0, len(grasps), max(1, len(grasps) // 60))]
    asked = Grasps(*(a.astype(np.float32) for a in (some.rotations, some.middles, some.widths, some.widths * 0 + 1)))
    assert np.isfinite(find_contacts(asked, surface).points).all(axis=(1, 2)).mean() > 0.95


@pytest.mark.parametrize(
    ("piece", "volume"),
    [
        (CollisionPiece("box", (0.01, 0.02, 0.03)), 8 * 0.01 * 0.02 * 0.03),
        (CollisionPiece("sphere", (0.03,)), 4 / 3 * np.pi * 0.03**3),
        (CollisionPiece("cylinder", (0.02, 0.04)), np.pi * 0.02**2 * 0.08),
        (CollisionPiece("capsule", (0.02, 0.04)), np.pi * 0.02**2 * 0.08 + 4 / 3 * np.pi * 0.02**3),
        (CollisionPiece("ellipsoid", (0.01, 0.02, 0.03)), 4 / 3 * np.pi * 0.01 * 0.02 * 0.03),
    ],
)
def test_pieces_have_their_size(piece, volume):
    from scipy.spatial import ConvexHull

    assert ConvexHull(corners(piece)).volume == pytest.approx(volume, rel=0.06)


def test_points_cover_the_outside_only():
    """Two overlapping boxes: no point of either lies inside of the other."""
    two = CollisionPiece("box", (0.02, 0.02, 0.02)), CollisionPiece("box", (0.01, 0.01, 0.05))
    cross = SimObject("cross", "block", (), (), 0.1, 0.6, CUBE.visuals, two)
    pieces = ConvexPieces.of(two)
    assert (pieces.depth(surface_points(cross).astype(float)) < 0.001).all()
    assert len(surface_points(cross)) > 200
