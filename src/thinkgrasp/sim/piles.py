"""Physics of a pile: objects fall one after another, what leaves the workspace is put back."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.geometry import make_transform, rotation_from_quat_wxyz
from thinkgrasp.motion.cell import WORKSPACE_M
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.world import TIMESTEP_S, World

Float = NDArray[np.float64]

INTERVAL_S = 0.15
"""Simulated time between two drops; earlier ones may still be falling."""
CLEARANCE_M = 0.01
"""What a thing that starts to fall keeps from everything below it."""
TAKEABLE_M = 0.078
"""Widest side that fits between the fingers with room to spare."""
MAX_TILT_RAD = 0.8
"""Vessels that need their rim do not fall upside down: nobody could take them, nor what lies under them."""
FALL_M = 0.06
"""Least height of a fall."""
SETTLE_S = 2.0
HOLD_S, HOLD_M = 0.4, 0.005
"""A pile that is set up anew moves by no more than this in this time."""
FENCE_M = 0.03
"""Where things that move are stopped, inside the workspace's edge."""
FENCE_PERIOD_S = 0.03
STOPPED_M_S = 0.02
PUT_BACK_ROUNDS = 12
PUT_BACK_TRIES = 100
INNER_M = 0.07
"""Things are dropped at least this far inside the workspace's edge."""
EDGE_M = 0.035
"""The same for what is put back."""


def needs_its_rim(obj: SimObject) -> bool:
    """Whether a vessel is so wide that a two-finger gripper can take it by the rim only."""
    return "rim" in obj.parts and float(np.sort(np.diff(obj.bounds_m, axis=0)[0])[1]) > TAKEABLE_M


class Pile:
    """Objects that are being dropped into a world; poses are those of the moment each began to fall."""

    def __init__(self, world: World, rng: Generator) -> None:
        self.world = world
        self.rng = rng
        self.drops = np.tile(np.eye(4), (len(world.objects), 1, 1))
        """(N, 4, 4) T_world_object at the start of each fall."""
        self.dropped: list[int] = []
        self._corners = [np.array(list(product(*obj.bounds_m.T))) for obj in world.objects]
        for index in range(len(world.objects)):
            world.park(index)

    def drop(self, index: int, xy: Float) -> None:
        """Let an object fall at xy (2,) with a random orientation, from above all that lies or falls there."""
        self._fall(index, np.clip(xy, *np.transpose(_INNER)), self._random_rotation(index), FALL_M)

    def drop_at(self, index: int, T_world_object: Float) -> None:
        """Let an object fall from a given pose (4, 4), from higher where something is in the way."""
        self._fall(index, T_world_object[:2, 3], T_world_object[:3, :3], FALL_M)

    def scatter(self, index: int) -> None:
        """Let an object fall anywhere over the middle of the workspace."""
        self.drop(index, np.array([self.rng.uniform(*side) for side in SCATTER_M]))

    def put_back(self, index: int) -> None:
        """Let an object fall where there is most room, upright and from so low that it hardly rolls."""
        angle = self.rng.uniform(0, 2 * np.pi)
        R = rotation_from_quat_wxyz(np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]))
        spots = np.stack([self.rng.uniform(*side, PUT_BACK_TRIES) for side in _EDGE], axis=1)
        self._fall(index, spots[self._floors(index, spots, R).argmin()], R, 0.0)

    def take_back(self, index: int, lay: Float) -> None:
        """Undo the fall of an object; the others lie as they did at `lay`, the poses (N, 4, 4) before it."""
        self.world.park(index)
        self.dropped.remove(index)
        for other in self.dropped:
            self.world.place(other, lay[other])

    def wait(self) -> None:
        """Let what falls come to rest."""
        self._pass(SETTLE_S)

    def settle(self) -> bool:
        """Wait until all is at rest, putting back what left the workspace; return whether all lies still inside."""
        for _ in range(PUT_BACK_ROUNDS):
            still = self._pass(SETTLE_S)
            outside = self.outside()
            if still and not outside and self._holds():
                return True
            for index in outside:
                self.world.park(index)
            for index in outside:
                self.put_back(index)
        return False

    def _pass(self, seconds: float) -> bool:
        """Let time pass inside a fence: what rolls out is brought to a stop. Return whether all came to rest sooner."""
        for _ in range(round(seconds / FENCE_PERIOD_S)):
            self.world.step(round(FENCE_PERIOD_S / TIMESTEP_S))
            for index in self.dropped:
                if self._leaves(index):
                    self.world.place(index, self.world.pose(index))
            if self.world.at_rest():
                return True
        return False

    def _holds(self) -> bool:
        """Whether the pile stays as it lies when it is set up anew: what sleeps in an unstable place does not."""
        poses = self.world.poses()
        before = self._centers()
        self._set_up(poses)
        self.world.step(round(HOLD_S / TIMESTEP_S))
        holds = bool(np.linalg.norm(self._centers() - before, axis=1).max() < HOLD_M)
        if holds:
            self._set_up(poses)
        return holds

    def _centers(self) -> Float:
        return np.array([self.world.center(index) for index in self.dropped])

    def _set_up(self, poses: Float) -> None:
        now = self.world.time_s
        mujoco.mj_resetData(self.world.model, self.world.data)
        self.world.data.time = now
        for index in range(len(poses)):
            if index in self.dropped:
                self.world.place(index, poses[index])
            else:
                self.world.park(index)
        mujoco.mj_forward(self.world.model, self.world.data)

    def _leaves(self, index: int) -> bool:
        if self.world.speed(index)[0] <= STOPPED_M_S:
            return False
        return bool((np.abs(self.world.center(index)[:2] - _MIDDLE) > _FENCE).any())

    def _random_rotation(self, index: int) -> Float:
        if needs_its_rim(self.world.objects[index]):
            axis = self.rng.standard_normal(3) * [1, 1, 0]
            tilt = self.rng.uniform(0, MAX_TILT_RAD) * axis / np.linalg.norm(axis)
            return Rotation.from_rotvec([0, 0, self.rng.uniform(0, 2 * np.pi)]).as_matrix() @ (
                Rotation.from_rotvec(tilt).as_matrix()
            )
        return rotation_from_quat_wxyz(self.rng.standard_normal(4))

    def _fall(self, index: int, xy: Float, R: Float, height_m: float) -> None:
        low, high = _extent(self._corners[index] @ R.T)
        z = max(height_m, float(self._floors(index, xy[None], R)[0]) + CLEARANCE_M)
        T = make_transform(R, np.array([*(xy - (low + high)[:2] / 2), z - low[2]]))
        self.drops[index] = T
        self.world.place(index, T)
        if index not in self.dropped:
            self.dropped.append(index)
        self._pass(INTERVAL_S)

    def _floors(self, index: int, xy: Float, R: Float) -> Float:
        """Return the heights (S,) of the highest bounding box that an object at each xy (S, 2) meets; 0 = the table."""
        low, high = _extent(self._corners[index] @ R.T)
        half = (high - low)[:2] / 2
        floor = np.zeros(len(xy))
        for other in self.dropped:
            if other != index and not self.world.is_parked(other):
                T = self.world.pose(other)
                lowest, highest = _extent(self._corners[other] @ T[:3, :3].T + T[:3, 3])
                meets = ((highest[:2] > xy - half) & (lowest[:2] < xy + half)).all(axis=1)
                floor = np.where(meets, np.maximum(floor, highest[2]), floor)
        return floor

    def outside(self) -> list[int]:
        """Return the dropped objects whose middle is not over the workspace."""
        (x0, x1), (y0, y1) = WORKSPACE_M
        centers = {i: self.world.center(i) for i in self.dropped}
        return [i for i, (x, y, z) in centers.items() if not (x0 <= x <= x1 and y0 <= y <= y1 and z > 0)]


def _extent(points: Float) -> tuple[Float, Float]:
    return points.min(axis=0), points.max(axis=0)


def _shrunk(sides: Sequence[tuple[float, float]], by: float) -> tuple[tuple[float, float], ...]:
    return tuple((low + by, high - by) for low, high in sides)


_INNER = _shrunk(WORKSPACE_M, INNER_M)
_EDGE = _shrunk(WORKSPACE_M, EDGE_M)
_MIDDLE = np.mean(WORKSPACE_M, axis=1)
_FENCE = np.diff(WORKSPACE_M, axis=1)[:, 0] / 2 - FENCE_M
SCATTER_M = _shrunk(WORKSPACE_M, 0.1)
"""Where things fall when nothing aims them, about as in the published layouts."""
