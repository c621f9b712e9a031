"""The rules that stand between a plan and a moving arm: pure functions, each with a named reason when it says no.

None of this replaces the robot's own safety functions, which have to be set up on its pendant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import make_transform
from thinkgrasp.lab.cell import Cell
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.trajectory import PERIOD_S, Trajectory
from thinkgrasp.types import Frame, Grasp

Float = NDArray[np.float64]

Reason = Literal[
    "invalid_pose",
    "outside_workspace",
    "outside_grasping_area",
    "too_fast",
    "jump",
    "unreachable",
    "collision",
    "missed",
    "slipped",
    "refused_by_person",
    "stopped_by_person",
    "protective_stop",
    "safeguard_stop",
    "emergency_stop",
    "safety_fault",
    "robot_not_ready",
    "connection_lost",
    "off_track",
    "no_way_home",
    "not_at_home",
    "gripper_silent",
    "gripper_fault",
    "checks_failed",
    "dry_run",
]
"""Why an attempt ended without the thing in the bin; in an `Outcome` and in the log."""

HALTS: frozenset[Reason] = frozenset(
    {
        *("stopped_by_person", "protective_stop", "safeguard_stop", "emergency_stop", "safety_fault"),
        *(
            "robot_not_ready",
            "connection_lost",
            "off_track",
            "no_way_home",
            "not_at_home",
            "gripper_silent",
            "gripper_fault",
            "checks_failed",
        ),
    }
)
"""After these nothing moves any more until a person has looked and the run is started anew."""

START_TOLERANCE_RAD = 0.02
"""A motion starts where the arm is, to within this."""
RATE_TOLERANCE = 1.02
"""Rounding of the samples; limits are meant to be kept, not met."""
ROBOT_RUNNING = 7
_NORMAL_BITS = 0b11
_BIT_REASONS: tuple[tuple[int, Reason], ...] = (
    (5, "emergency_stop"),
    (6, "emergency_stop"),
    (7, "emergency_stop"),
    (8, "safety_fault"),
    (9, "safety_fault"),
    (4, "safeguard_stop"),
    (2, "protective_stop"),
    (3, "safety_fault"),
    (10, "safety_fault"),
)
"""Bits of the controller's safety status, gravest first; 0 and 1 are normal and reduced mode."""


@dataclass(frozen=True)
class Refusal:
    """A rule said no."""

    reason: Reason
    detail: str


def check_grasp(grasp: Grasp, T_world_tcp: Float, cell: Cell | None) -> Refusal | None:
    """Look at a grasp before anything is planned: finite, a rotation, an opening, inside of the grasping area."""
    numbers = [grasp.rotation.ravel(), grasp.position, [grasp.width_m], T_world_tcp.ravel()]
    if not all(np.isfinite(n).all() for n in numbers):
        return Refusal("invalid_pose", "the grasp holds numbers that are not finite")
    R = T_world_tcp[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        return Refusal("invalid_pose", "the grasp's rotation is none")
    if not 0 <= grasp.width_m < 1:
        return Refusal("invalid_pose", f"the grasp's opening is {grasp.width_m:g} m")
    if cell is None:
        return None
    p, (low, high) = T_world_tcp[:3, 3], np.array(cell.grasping_m)
    if not ((p >= low) & (p <= high)).all():
        return Refusal(
            "outside_grasping_area",
            f"the fingertips would close at {_place(p)}, allowed is {_place(low)} to {_place(high)}",
        )
    return None


def check_motion(trajectory: Trajectory, q_now: Float, cell: Cell, *, tcp_speed_m_s: float) -> Refusal | None:
    """Look at a motion, sample by sample, before it is sent to the arm.

    Args:
        trajectory: Joint positions over time.
        q_now: (6,) where the arm is [rad].
        cell: Box, joint ranges, speed and acceleration.
        tcp_speed_m_s: Allowed of fingertips and flange.
    """
    q = trajectory.positions
    if q.ndim != 2 or q.shape[1] != 6 or not np.isfinite(q).all() or not np.isfinite(trajectory.times_s).all():
        return Refusal("invalid_pose", "the motion holds joint angles that are not finite")
    start = float(np.abs(q[0] - q_now).max()) if np.isfinite(q_now).all() else np.inf
    if start > START_TOLERANCE_RAD:
        return Refusal("jump", f"the motion starts {start:.3f} rad from where the arm is")
    if not ur5e.LIMITS.contain(q).all():
        return Refusal("outside_workspace", "the motion leaves the joints' ranges")
    low, high = np.array(cell.workspace_m)
    for what, points in _watched(q, cell).items():
        outside = ~((points >= low) & (points <= high)).all(axis=1)
        if outside.any():
            at = _place(points[int(np.argmax(outside))])
            return Refusal(
                "outside_workspace", f"the {what} would be at {at}, allowed is {_place(low)} to {_place(high)}"
            )
    joint = joint_speed(q)
    if joint > cell.limits.joint_speed_rad_s * RATE_TOLERANCE:
        return Refusal(
            "too_fast", f"a joint would turn at {joint:.2f}, allowed are {cell.limits.joint_speed_rad_s} rad/s"
        )
    turn, allowed = joint_acceleration(q), cell.limits.joint_acceleration_rad_s2
    if turn > allowed * RATE_TOLERANCE:
        return Refusal("too_fast", f"a joint would speed up or brake by {turn:.1f}, allowed are {allowed} rad/s^2")
    tcp = tip_speed(q, cell)
    if tcp > tcp_speed_m_s * RATE_TOLERANCE:
        return Refusal("too_fast", f"the fingertips would move at {tcp:.3f}, allowed are {tcp_speed_m_s:.3f} m/s")
    return None


def slowed_to(trajectory: Trajectory, cell: Cell, *, tcp_speed_m_s: float) -> Trajectory:
    """Return the same path, run slower by as much as a joint or the fingertips would be too fast."""
    q = trajectory.positions
    factor = max(joint_speed(q) / cell.limits.joint_speed_rad_s, tip_speed(q, cell) / tcp_speed_m_s)
    if factor <= 1:
        return trajectory
    steps = int(np.ceil((len(q) - 1) * factor))
    at = np.linspace(0, len(q) - 1, steps + 1)
    slow = np.stack([np.interp(at, np.arange(len(q)), joint) for joint in q.T], axis=1)
    return Trajectory(np.arange(len(slow), dtype=np.float64) * PERIOD_S, slow)


def describe(motion: Trajectory, cell: Cell) -> str:
    """Say in words how long a motion takes, where the fingertips end, and how fast it becomes."""
    return (
        f"{motion.duration_s:.1f} s, fingertips to {_place(cell.fingertips(motion.end)[:3, 3])}, at most "
        f"{tip_speed(motion.positions, cell):.2f} m/s and {joint_speed(motion.positions):.2f} rad/s"
    )


def joint_speed(q: Float) -> float:
    """Return the largest speed of any joint [rad/s] over samples (T, 6) that are PERIOD_S apart."""
    return float(np.abs(np.diff(q, axis=0)).max(initial=0.0)) / PERIOD_S


def joint_acceleration(q: Float) -> float:
    """Return the largest acceleration of any joint [rad/s^2], from rest to rest, over samples (T, 6) PERIOD_S apart."""
    resting = np.concatenate([q[:1], q, q[-1:]])
    return float(np.abs(np.diff(resting, 2, axis=0)).max(initial=0.0)) / PERIOD_S**2


def tip_speed(q: Float, cell: Cell) -> float:
    """Return the largest speed of fingertips or flange [m/s] over samples (T, 6) that are PERIOD_S apart."""
    steps = [np.linalg.norm(np.diff(p, axis=0), axis=1).max(initial=0.0) for p in _watched(q, cell).values()]
    return float(max(steps)) / PERIOD_S


def _watched(q: Float, cell: Cell) -> dict[str, Float]:
    """Return the world points (T, 3) that have to stay in the box."""
    return {"fingertips": cell.fingertips(q)[:, :3, 3], "flange": cell.flange(q)[:, :3, 3]}


def safety_refusal(bits: int, robot_mode: int) -> Refusal | None:
    """Read the controller's safety status bits and robot mode; None where the arm may move."""
    for bit, reason in _BIT_REASONS:
        if bits >> bit & 1:
            return Refusal(reason, f"the robot's safety system says {reason.replace('_', ' ')} (bits {bits:#b})")
    if not bits & _NORMAL_BITS:
        return Refusal("safety_fault", f"the robot is in neither normal nor reduced mode (bits {bits:#b})")
    if robot_mode != ROBOT_RUNNING:
        return Refusal(
            "robot_not_ready", f"robot mode is {robot_mode}, needed is {ROBOT_RUNNING} (power on, brakes released)"
        )
    return None


def presses_too_hard(wrench: Float, before: Float, limit_n: float) -> bool:
    """Whether the force at the flange (first three of (6,) [N]) differs from what it was by more than the limit.

    Forces that are not finite count as too much.
    """
    force = float(np.linalg.norm(np.asarray(wrench)[:3] - np.asarray(before)[:3]))
    return not force <= limit_n


def pose_from_ur(pose: Float) -> Float:
    """Return the transform (4, 4) of a pose as the controller writes it: x, y, z [m] and a rotation vector [rad]."""
    from scipy.spatial.transform import Rotation

    pose = np.asarray(pose, np.float64)
    return make_transform(Rotation.from_rotvec(pose[3:6]).as_matrix(), pose[:3])


def grasp_in_world(grasp: Grasp, frame: Frame) -> Float | None:
    """Return T_world_tcp (4, 4) of a grasp in a frame's camera coordinates; None where the camera's pose is unknown."""
    if frame.T_world_camera is None:
        return None
    with np.errstate(invalid="ignore"):  # what is not finite is refused by `check_grasp`
        return frame.T_world_camera @ make_transform(grasp.rotation, grasp.position)


def _place(p: Float) -> str:
    return "(" + ", ".join(f"{c:.3f}" for c in np.asarray(p)) + ") m"
