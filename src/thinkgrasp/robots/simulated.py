"""The simulated UR5e with its 2F-85: carries a grasp out step by step, and verifies what happened by touch.

Open, approach, close with limited force, lift, verify, carry to the bin, verify again, release, go home. Motions are
planned against the perceived cloud of the frame that the grasp was found in, never against the simulator's truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import apply, invert, make_transform
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.motion.cell import BIN, HOME_RAD
from thinkgrasp.motion.robotiq_2f85 import PAD_HALF_M, STROKE_M, flange_to_tip
from thinkgrasp.motion.trajectory import Trajectory, time_path
from thinkgrasp.motion.ur5e import LIMITS
from thinkgrasp.robots.pinch import MAX_RETREAT_M, over_bin, perceived_cloud, retreat_for_arc, without_taken
from thinkgrasp.sim.world import GRIP_FORCE_N, TIMESTEP_S, World
from thinkgrasp.types import Frame, Grasp, Outcome

Float = NDArray[np.float64]

TICK_S = 0.01
"""Between two commands to the servos, and between two looks at the forces."""
STOP_FORCE_N = 90.0
"""A motion that presses harder than this on anything but what it holds is stopped."""
CLOSING_M_S = 0.15
SLIP_M = 0.03
"""What is held may shift by this much in the gripper between two verifications."""
WATCH_S = 0.1


@dataclass(frozen=True)
class Truth:
    """What really happened in an attempt, for referees and statistics; the pipeline never sees it."""

    touched: int | None
    """Object that both fingers held after closing, by contact."""
    delivered: int | None
    """Object that was let go over the bin."""


class Stopped(Exception):
    """A motion was stopped because it pressed on something.

    Args:
        travelled: Joint angles (K, 6) of the motion so far, oldest first.
    """

    def __init__(self, travelled: Float) -> None:
        super().__init__("the robot pressed on something")
        self.travelled = travelled


class SimulatedRobot:
    """Executes grasps in a World.

    Args:
        world: With its robot.
        motion: Plans the arm's motions.
        force_n: What each pad presses with.

    Raises:
        InputError: The world has no robot.
    """

    def __init__(
        self,
        world: World,
        motion: ArmMotion | None = None,
        *,
        force_n: float = GRIP_FORCE_N,
    ) -> None:
        if not world.has_robot:
            raise InputError("this world was made without a robot")
        self.world = world
        self.motion = motion or ArmMotion()
        self.force_n = force_n
        self.watchers: list[Callable[[], None]] = []
        self.truth = Truth(None, None)
        self._watched_s = 0.0

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        """Carry out a grasp given in the frame's camera coordinates.

        Returns:
            "held" when the thing was let go over the bin; else "unreachable", "collision", "missed" or "slipped".

        Raises:
            InputError: The frame's camera pose is unknown.
        """
        if frame.T_world_camera is None:
            raise InputError("the simulated robot needs the camera's pose: T_world_camera is missing in the frame")
        self.truth = Truth(None, None)
        T_world_tcp = frame.T_world_camera @ make_transform(grasp.rotation, grasp.position)
        opening = min(grasp.width_m, STROKE_M)
        retreat = retreat_for_arc(T_world_tcp, opening)
        if retreat > MAX_RETREAT_M:
            return Outcome(False, "unreachable")
        T_world_tcp[:3, 3] -= retreat * T_world_tcp[:3, 2]
        cloud = perceived_cloud(frame)
        plan = self.motion.plan_grasp(self.world.joints(), T_world_tcp, opening, cloud)
        if isinstance(plan, str):
            return Outcome(False, "unreachable")
        try:
            self._move_gripper(opening)
            self._follow(plan.to_pregrasp)
            self._follow(plan.approach)
        except Stopped as stop:
            self._back_out(stop)
            return Outcome(False, "collision")
        self._close()
        grasped = self.world.held()
        self.truth = Truth(grasped, None)
        grip = None if grasped is None else self._grip_point(grasped)
        try:
            self._follow(plan.lift, held=grasped)
        except Stopped as stop:
            self._release()
            self._back_out(stop)
            return Outcome(False, "collision")
        if grasped is None or grip is None or not self._still_holds(grasped, grip):
            self._release()
            self._go_home(cloud)
            return Outcome(False, "missed" if grasped is None else "slipped")
        return self._deliver(grasped, without_taken(cloud, T_world_tcp), float(T_world_tcp[2, 3]))

    def _deliver(self, held: int, cloud: Float, taken_at_z: float) -> Outcome:
        """Carry what is held to the bin, high enough for all that may hang below the fingers, and let it go."""
        grip = self._grip_point(held)
        poses = over_bin(BIN, taken_at_z)
        opening = self.world.opening()
        way = self.motion.plan_to_poses(self.world.joints(), poses, opening, cloud)
        if isinstance(way, str):
            self._release()
            self._go_home(cloud)
            return Outcome(False, "unreachable")
        try:
            self._follow(way, held=held)
        except Stopped as stop:
            self._release()
            self._back_out(stop)
            return Outcome(False, "collision")
        if not self._still_holds(held, grip):
            self._release()
            self._go_home(cloud)
            return Outcome(False, "slipped")
        self.truth = Truth(held, held)
        self._release()
        self._wait(0.2)
        self._go_home(cloud)
        return Outcome(True, "held")

    # -- verification ------------------------------------------------------------------------------------------------

    def _grip_point(self, index: int) -> Float:
        """The point (3,) of an object that is between the pads now, in its own frame."""
        return np.asarray(apply(invert(self.world.pose(index)), self._between_pads()), np.float64)

    def _between_pads(self) -> Float:
        T_flange_pads = flange_to_tip(self.world.opening())
        T_flange_pads[2, 3] -= PAD_HALF_M[2]
        return (self.world.flange() @ T_flange_pads)[:3, 3]

    def _still_holds(self, index: int, grip: Float) -> bool:
        """Whether an object touches both fingers, and what was between them has stayed there; it may have turned."""
        right, left = self.world.pad_contacts()
        moved = apply(self.world.pose(index), grip) - self._between_pads()
        return index in right & left and float(np.linalg.norm(moved)) <= SLIP_M

    # -- motion ------------------------------------------------------------------------------------------------------

    def _follow(self, trajectory: Trajectory, *, held: int | None = None, guarded: bool = True) -> None:
        """Move along a trajectory; raise Stopped where the robot presses on something."""
        times = np.arange(1, int(np.ceil(trajectory.duration_s / TICK_S)) + 1) * TICK_S
        positions = np.array([trajectory.sample(min(t, trajectory.duration_s)) for t in times])
        velocities = np.zeros_like(positions)
        if len(positions) > 1:
            velocities[:] = np.gradient(positions, TICK_S, axis=0)
        for i, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
            self.world.command(position, velocity)
            self._tick()
            if guarded and self.world.collision_force(held) > STOP_FORCE_N:
                self.world.command(self.world.joints(), np.zeros(6))
                self._wait(0.05)
                raise Stopped(positions[: i + 1])
        self.world.command(trajectory.end, np.zeros(6))
        self._wait(0.05)

    def _move_gripper(self, opening: float) -> None:
        """Open or close to an opening at limited speed, in free air."""
        start = self.world.opening()
        ticks = max(1, int(abs(opening - start) / CLOSING_M_S / TICK_S))
        for k in range(1, ticks + 1):
            self.world.command_gripper(start + (opening - start) * k / ticks, self.force_n)
            self._tick()

    def _close(self) -> None:
        """Close until the fingers stand still, and let the grip build up."""
        opening, target, still = self.world.opening(), self.world.opening(), 0
        for _ in range(200):
            target = max(target - CLOSING_M_S * TICK_S, 0.0)
            self.world.command_gripper(target, self.force_n)
            self._tick()
            still = still + 1 if abs(self.world.opening() - opening) < 2e-5 and target < opening - 2e-3 else 0
            opening = self.world.opening()
            if still >= 3 or (target == 0.0 and opening < 1e-3):
                break
        self.world.command_gripper(0.0, self.force_n)
        self._wait(0.15)

    def _release(self) -> None:
        self._move_gripper(STROKE_M)
        self._wait(0.1)

    def _go_home(self, cloud: Float) -> None:
        home = np.array(HOME_RAD)
        way = self.motion.plan_to(self.world.joints(), home, self.world.opening(), cloud)
        if isinstance(way, str):
            way = self.motion.direct(self.world.joints(), home)
        try:
            self._follow(way)
        except Stopped as stop:
            self._back_out(stop)
        self.world.settle(max_seconds=1.0)

    def _back_out(self, stop: Stopped) -> None:
        """Leave after a stop: back the way it came, then home, without minding contacts."""
        way_back = time_path(stop.travelled[::-1], LIMITS, speed=0.5)
        self._follow(way_back, guarded=False)
        self._follow(self.motion.direct(self.world.joints(), np.array(HOME_RAD)), guarded=False)
        self._move_gripper(STROKE_M)
        self.world.settle(max_seconds=1.0)

    def _wait(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds / TICK_S))):
            self._tick()

    def _tick(self) -> None:
        self.world.step(round(TICK_S / TIMESTEP_S))
        if self.watchers and self.world.time_s - self._watched_s >= WATCH_S:
            self._watched_s = self.world.time_s
            for watcher in self.watchers:
                watcher()
