"""What could be taken now, and what truly stands in the way of what could not: by geometry, never by a camera.

For metrics only. No stage of the pipeline imports this module.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.benchmark.perfect_model import PictureTruth, view_of_picture
from thinkgrasp.benchmark.true_grasps import ENGAGEMENT_M, TrueGrasps, grasps_on, reach_beside, surface_points
from thinkgrasp.errors import InputError
from thinkgrasp.gripper import GRIPPERS, Gripper
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.motion.cell import BIN, HOME_RAD
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import TABLE_LIMITS_M, World

Float = NDArray[np.float64]
_Answer = TypeVar("_Answer")

MAX_TILT_RAD = float(np.deg2rad(60.0))
"""Largest angle between the approach and straight down, as generators have it."""
TABLE_GAP_M = 0.002
"""What fingers and palm keep from the table."""
PAD_SHARE = 0.5
"""Of the pad's length, how far the tips go past the contacts at most."""
STANDOFF_M = 0.10
"""Length of the straight way in."""
MAX_GRASPS = 400
"""Grasps looked at per object and state, drawn once with a fixed seed."""
MAX_REACHED = 48
"""Of those that nothing blocks, for how many the arm is asked, the steepest first."""
MAX_PER_SET = 6
"""Of the grasps that the same things block, for how many the arm is asked."""
IN_VIEW_SHARE = 1 / 4000
"""A thing is in view where it fills this share of the image."""
HIDING_SHARE = 0.05
"""Of a goal's outline that a thing must cover to count as hiding it."""
VIEW_WIDTH_PX = 224
TOPPLED_COS = float(np.cos(np.deg2rad(45.0)))


@dataclass(frozen=True)
class Judgement:
    """Whether the thing chosen for a step was a right one, and how easy that was."""

    right: bool
    """A goal that can be taken; where none can, a true obstruction of one. See `Reachability.right_choices`."""
    chance: float
    """Share 0..1 of the things in view that would have been right; 0 also where nothing in view would have been."""
    goal_takeable: bool
    """Whether any goal could be taken."""


@dataclass(frozen=True, eq=False)
class _Approaches:
    """Grasps on one object as it lies that its own shape and the table allow, and the bodies in the way of each."""

    grasps: TrueGrasps
    depth: Float
    """(C,) how far the tips go past the contacts [m]."""
    others: tuple[int, ...]
    blocks: NDArray[np.bool_]
    """(len(others), C)."""

    def poses(self, rows: NDArray[np.intp]) -> Float:
        """Return T_world_tcp (K, 4, 4) of some of the grasps."""
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, :3] = self.grasps.rotations[rows]
        T[:, :3, 3] = self.grasps.middles[rows] + self.depth[rows, None] * T[:, :3, 2]
        return T


class Reachability:
    """The truth about what can be taken, for the state that a world was in at the last `refresh`.

    Args:
        world: Read, never changed but for geom groups while an outline is looked for.
        goals: Indices of the objects that serve the instruction.
        views: Through which a planner looks; without any, everything on the table counts as seen.
        gripper: Default: the 2F-85.
        motion: The arm and what stands still around it; default: the simulated cell's.

    Raises:
        InputError: No goal, or one that is not an object of the world.
    """

    def __init__(
        self,
        world: World,
        goals: Collection[int],
        views: Sequence[CameraView] = (),
        *,
        gripper: Gripper | None = None,
        motion: ArmMotion | None = None,
    ) -> None:
        n = len(world.objects)
        if not goals or not all(0 <= g < n for g in goals):
            raise InputError(f"goals must be one or more of the objects 0..{n - 1}, got {sorted(goals)}")
        self.world = world
        self.goals = tuple(sorted(set(goals)))
        self._views = tuple(_small(view) for view in views)
        self._gripper = gripper or GRIPPERS["robotiq_2f85"]
        self._motion = motion or ArmMotion(standoff_m=STANDOFF_M)
        self.refresh()

    def refresh(self) -> None:
        """Take the world as it is now; to be called before each step, as answers are kept until then."""
        self._poses = self.world.poses()
        self._present = tuple(i for i in range(len(self._poses)) if self.world.on_table(i))
        self._clouds: dict[int, Float] = {}
        self._known: dict[tuple[str, int], object] = {}

    # -- what can be taken -------------------------------------------------------------------------------------------

    def takeable(self, index: int) -> bool:
        """Whether a grasp on an object exists that could be carried out now.

        Its contacts close at the object's own friction and within the gripper's opening; fingers and palm, on the
        straight way in too, keep clear of the object, of all others and of the table; and the arm reaches it as the
        loop's reach check says, given the true surfaces of all that is on the table.
        """
        return self._once("takeable", index, self._is_takeable)

    def _is_takeable(self, index: int) -> bool:
        if index not in self._present:
            return False
        ways = self._approaches(index)
        free = _spread(ways.grasps, np.flatnonzero(~ways.blocks.any(axis=0)), MAX_REACHED)
        return self._reaches(ways, free, self._present)

    def _approaches(self, index: int) -> _Approaches:
        return self._once("approaches", index, self._find_approaches)

    def _find_approaches(self, index: int) -> _Approaches:
        gripper = self._gripper
        grasps = grasps_on(self.world.objects[index], gripper).moved(self._poses[index])
        grasps = grasps[-grasps.rotations[:, 2, 2] >= np.cos(MAX_TILT_RAD) - 1e-6]
        depth = np.minimum(np.minimum(grasps.reach, _above_table(grasps, gripper)), PAD_SHARE * gripper.pad_length_m)
        good = np.flatnonzero(depth >= ENGAGEMENT_M)[:MAX_GRASPS]
        grasps, depth = grasps[good], depth[good]
        others = tuple(i for i in self._present if i != index)
        reach = np.full((len(others), len(grasps)), np.inf)
        for row, i in enumerate(others):
            obj, T = self.world.objects[i], self._poses[i]
            reach[row] = reach_beside(grasps, depth, gripper, obj, T, STANDOFF_M)
        blocks = reach < ENGAGEMENT_M
        free = np.where(blocks, np.inf, reach).min(axis=0, initial=np.inf)
        return _Approaches(grasps, np.minimum(depth, free), others, blocks)

    def _cloud(self, index: int) -> Float:
        if index not in self._clouds:
            T = self._poses[index]
            self._clouds[index] = surface_points(self.world.objects[index]) @ T[:3, :3].T + T[:3, 3]
        return self._clouds[index]

    def _reaches(self, ways: _Approaches, rows: NDArray[np.intp], seen: Iterable[int]) -> bool:
        """Whether the arm can carry out any of these grasps among the true surfaces of some objects."""
        if len(rows) == 0:
            return False
        # Twice, since one lone point at a place is no obstacle to the planner.
        cloud = np.concatenate([np.zeros((0, 3)), *(self._cloud(i) for i in seen for _ in range(2))])
        widths = ways.grasps.widths[rows]
        return bool(self._motion.reaches(np.array(HOME_RAD), ways.poses(rows), widths, cloud, at_most=1).any())

    # -- what is in the way ------------------------------------------------------------------------------------------

    def blockers(self, index: int) -> frozenset[int]:
        """Return the objects of the smallest blocking sets of an object; none where it can be taken.

        The blocking set of a grasp that is fine otherwise, and that the arm reaches where nothing lies on the table,
        are the objects in the way of its fingers, palm or way in; or, where those are clear, the objects each of which
        alone keeps the arm away. All sets of the least size count. Empty too where no such grasp exists.
        """
        return self._once("blockers", index, self._find_blockers)[0]

    def blocking_size(self, index: int) -> int:
        """Return the size of an object's smallest blocking sets; 0 where `blockers` is empty."""
        return self._once("blockers", index, self._find_blockers)[1]

    def _find_blockers(self, index: int) -> tuple[frozenset[int], int]:
        if index not in self._present or self.takeable(index):
            return frozenset(), 0
        ways = self._approaches(index)
        others = np.array(ways.others, np.intp)
        sizes = ways.blocks.sum(axis=0)
        for size in np.unique(sizes):
            rows = np.flatnonzero(sizes == size)
            if size == 0:
                found, size = self._arm_blockers(ways, rows)
            else:
                found = frozenset[int]()
                sets, which = np.unique(ways.blocks[:, rows], axis=1, return_inverse=True)
                for k in range(sets.shape[1]):
                    same = _spread(ways.grasps, rows[which.ravel() == k], MAX_PER_SET)
                    if self._reaches(ways, same, ()):
                        found |= frozenset(others[sets[:, k]].tolist())
            if found:
                return found, int(size)
        return frozenset(), 0

    def _arm_blockers(self, ways: _Approaches, rows: NDArray[np.intp]) -> tuple[frozenset[int], int]:
        sets = []
        for row in _spread(ways.grasps, rows, MAX_PER_SET):
            one = np.array([row])
            if self._reaches(ways, one, ()):
                sets.append(frozenset(i for i in self._present if not self._reaches(ways, one, (i,))))
        least = min((len(s) for s in sets if s), default=0)
        return frozenset[int]().union(*(s for s in sets if len(s) == least)), least

    def obstructions(self, goal: int) -> frozenset[int]:
        """Return the true obstructions of a goal.

        * The `blockers` of the goal where it cannot be taken.
        * Where no goal is in any of the views: what hides this one, that is, what covers at least HIDING_SHARE of its
          outline in a view.
        * The blockers of each of these that cannot be taken itself, and so on: to remove what lies on a blocker is a
          true step too.
        """
        return self._once("obstructions", goal, self._find_obstructions)

    def _find_obstructions(self, goal: int) -> frozenset[int]:
        if goal not in self._present:
            return frozenset()
        first = self.blockers(goal)
        if self._views and not set(self.goals) & set(self.in_view()):
            first |= self._hiders(goal)
        found, todo = set[int](), sorted(first)
        while todo:
            index = todo.pop()
            if index not in found and index != goal:
                found.add(index)
                todo += sorted(self.blockers(index))
        return frozenset(found)

    def _hiders(self, goal: int) -> frozenset[int]:
        hiders = set[int]()
        for picture in self._pictures():
            outline = picture.outline(goal)
            over = picture.labels[outline]
            counts = np.bincount(over[over >= 0], minlength=len(self.world.objects))
            hiders |= set(np.flatnonzero(counts >= max(HIDING_SHARE * outline.sum(), 1)).tolist())
        return frozenset(hiders - {goal})

    # -- what was chosen ---------------------------------------------------------------------------------------------

    def in_view(self) -> tuple[int, ...]:
        """Return the objects that fill at least IN_VIEW_SHARE of any of the views."""
        return self._once("in view", 0, self._find_in_view)

    def _find_in_view(self, _: int) -> tuple[int, ...]:
        if not self._views:
            return self._present
        seen = np.zeros(len(self.world.objects), bool)
        for picture in self._pictures():
            pixels = np.bincount(picture.labels[picture.labels >= 0], minlength=len(seen))
            seen |= pixels >= IN_VIEW_SHARE * picture.labels.size
        return tuple(i for i in self._present if seen[i])

    def _pictures(self) -> tuple[PictureTruth, ...]:
        return self._once("pictures", 0, self._look)

    def _look(self, _: int) -> tuple[PictureTruth, ...]:
        return tuple(PictureTruth(self.world, view, self.goals) for view in self._views)

    def right_choices(self) -> frozenset[int]:
        """Return what it would be right to take now.

        The goals that can be taken, where one of them is in view. Else those and the obstructions of all goals.
        """
        takeable = frozenset(g for g in self.goals if self.takeable(g))
        if takeable & set(self.in_view()):
            return takeable
        return takeable.union(*(self.obstructions(g) for g in self.goals))

    def chance(self) -> float:
        """Return the probability that an object drawn at random from those in view is a right choice."""
        seen = self.in_view()
        return len(self.right_choices() & set(seen)) / len(seen) if seen else 0.0

    def judge(self, chosen: int | None) -> Judgement:
        """Judge the choice of an object; None, nothing, is never right."""
        return Judgement(chosen in self.right_choices(), self.chance(), any(self.takeable(g) for g in self.goals))

    def _once(self, what: str, index: int, find: Callable[[int], _Answer]) -> _Answer:
        key = what, index
        if key not in self._known:
            self._known[key] = find(index)
        return self._known[key]  # type: ignore[return-value]


def _small(view: CameraView) -> CameraView:
    c = view.intrinsics
    width = min(VIEW_WIDTH_PX, c.width)
    return view_of_picture(view, (width, max(1, round(width * c.height / c.width))))


def _spread(grasps: TrueGrasps, rows: NDArray[np.intp], at_most: int) -> NDArray[np.intp]:
    """Return at most so many of the rows, spread over all tilts, steep approaches first."""
    tilt = np.arccos(np.clip(-grasps.rotations[rows, 2, 2], -1, 1))
    rows = rows[np.argsort(np.floor(tilt / np.deg2rad(20)), kind="stable")]
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(at_most, len(rows))).astype(np.intp))]


def _above_table(grasps: TrueGrasps, gripper: Gripper) -> Float:
    """Return how far (C,) [m] the tips may go past the middle before fingers or palm come too near to the table."""
    slope = np.abs(grasps.rotations[:, 2])
    fall = np.maximum(-grasps.rotations[:, 2, 2], 1e-6)
    px, py, _ = gripper.palm_size_m
    tips = slope[:, 0] * (grasps.widths / 2 + gripper.finger_thickness_m) + slope[:, 1] * gripper.finger_breadth_m / 2
    palm = slope[:, 0] * px / 2 + slope[:, 1] * py / 2 - fall * gripper.finger_length_m
    return (grasps.middles[:, 2] - np.maximum(tips, palm) - TABLE_GAP_M) / fall


def toppled(before: Float, after: Float, moved_by: Collection[int]) -> tuple[int, ...]:
    """Return the objects that an attempt toppled: still on the table, not taken, and turned over by more than 45 deg.

    What counts is the turn of an object's own up axis (z); a turn about the vertical is no toppling.

    Args:
        before: T_world_object (N, 4, 4).
        after: The same after the attempt.
        moved_by: Objects that the robot took, whether it kept them or not.
    """
    turned = (before[:, :3, 2] * after[:, :3, 2]).sum(axis=1) < TOPPLED_COS
    low, high = np.transpose(TABLE_LIMITS_M)
    origin = after[:, :3, 3]
    there = ((origin[:, :2] >= low) & (origin[:, :2] <= high)).all(axis=1) & (origin[:, 2] > -0.01)
    return tuple(
        i for i in np.flatnonzero(turned & there).tolist() if i not in moved_by and not BIN.contains(origin[i])
    )
