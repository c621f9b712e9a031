"""Do camera, arm and tool agree about where things are? Asked before the first move, and answered without moving.

Four findings, each from something measured: the tool that the controller believes in, the arm's kinematics, the table
top as the camera sees it, and the arm itself where the camera sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import deproject, invert, organised_normals
from thinkgrasp.lab.cell import Cell
from thinkgrasp.motion import ur5e
from thinkgrasp.perception.support import find_support
from thinkgrasp.types import Frame

if TYPE_CHECKING:
    from thinkgrasp.motion.collision import PlanningWorld

Float = NDArray[np.float64]

TCP_M, TCP_DEG = 0.008, 3.0
"""How far the controller's tool may be from the cell's, in place and in the direction of its axis."""
KINEMATICS_M, KINEMATICS_DEG = 0.008, 1.5
"""How far the controller's pose may be from the maker's nominal kinematics; arms are calibrated one by one."""
TABLE_M, TABLE_DEG = 0.012, 2.0
"""How far the table top that the camera sees may be from z = 0."""
ARM_M = 0.035
"""How far a point on the arm may be from the model of it, whose links are capsules."""
ARM_SHARE = 0.6
"""Of the points in view that have to be so near."""
ARM_POINTS = 40
"""Fewer points of the arm in view say nothing."""
BASE_M, BASE_DEG = 0.003, 0.5
"""How far the base pose at calibration may be from the cell's."""
HELD_OUT_MM, HELD_OUT_DEG = 10.0, 1.5
"""Largest median error of a calibration that is worked with."""
_RAYS_ACROSS = 160


@dataclass(frozen=True)
class Finding:
    """One check: "ok", "failed", or "open" where nothing could be measured."""

    name: str
    state: Literal["ok", "failed", "open"]
    detail: str

    def line(self) -> str:
        """Say it in one line."""
        return f"{self.state:<6} {self.name}: {self.detail}"


@dataclass(frozen=True, eq=False)
class CalibrationRecord:
    """What a camera file says of how its pose was found; as `thinkgrasp calibrate` wrote it."""

    mount: Literal["fixed", "hand"]
    T_world_base: Float
    held_out_mm: float
    held_out_deg: float
    poses: int


def all_findings(
    q: Float,
    T_base_tcp: Float,
    T_flange_tcp: Float | None,
    frame: Frame,
    *,
    cell: Cell,
    record: CalibrationRecord | None,
    opening_m: float,
    world: PlanningWorld,
) -> list[Finding]:
    """Return all of the findings below, for an arm that stood at q (6,) [rad] when the frame was seen."""
    return [
        tool_finding(q, T_base_tcp, cell),
        kinematics_finding(q, T_base_tcp, T_flange_tcp),
        record_finding(record, cell),
        table_finding(frame, cell),
        arm_finding(frame, q, opening_m, world),
    ]


def tool_finding(q: Float, T_base_tcp: Float, cell: Cell) -> Finding:
    """Compare the tool that the controller's pose implies with the cell's fingertips.

    Args:
        q: (6,) where the arm is [rad].
        T_base_tcp: (4, 4) where the controller says that its TCP is.
        cell: Whose coupling and gripper give the tool.
    """
    implied = invert(ur5e.forward(q)) @ T_base_tcp
    expected = cell.T_flange_tcp
    off_m = float(np.linalg.norm(implied[:3, 3] - expected[:3, 3]))
    off_deg = _angle_deg(implied[:3, 2], expected[:3, 2])
    text = (
        f"the controller's TCP is at {_mm(implied)} on the flange, the cell's fingertips at {_mm(expected)}: "
        f"{off_m * 1e3:.1f} mm and {off_deg:.1f} deg apart (allowed {TCP_M * 1e3:g} mm, {TCP_DEG:g} deg)"
    )
    good = off_m <= TCP_M and off_deg <= TCP_DEG
    advice = "" if good else "; set the TCP on the pendant, or robot.gripper.coupling_m in the cell file"
    return Finding("tool", "ok" if good else "failed", text + advice)


def kinematics_finding(q: Float, T_base_tcp: Float, T_flange_tcp: Float | None) -> Finding:
    """Compare the controller's own pose of its TCP with the maker's nominal kinematics of a UR5e.

    Args:
        q: (6,) where the arm is [rad].
        T_base_tcp: (4, 4) where the controller says that its TCP is.
        T_flange_tcp: (4, 4) the controller's TCP on the flange; None where it cannot be asked.
    """
    if T_flange_tcp is None:
        return Finding(
            "kinematics", "open", "the controller's TCP is known only when it is controlled (not in a dry run)"
        )
    nominal = ur5e.forward(q) @ T_flange_tcp
    off_m = float(np.linalg.norm(nominal[:3, 3] - T_base_tcp[:3, 3]))
    off_deg = _turn_deg(nominal[:3, :3].T @ T_base_tcp[:3, :3])
    good = off_m <= KINEMATICS_M and off_deg <= KINEMATICS_DEG
    text = f"controller and UR5e model differ by {off_m * 1e3:.1f} mm and {off_deg:.1f} deg"
    return Finding("kinematics", "ok" if good else "failed", text + ("" if good else "; is the arm a UR5e?"))


def record_finding(record: CalibrationRecord | None, cell: Cell) -> Finding:
    """Compare what the camera file says of its calibration with the cell as it is now."""
    if record is None:
        return Finding("calibration record", "open", "the camera file does not say how its pose was found")
    if record.mount != (cell.camera.mount if cell.camera else "fixed"):
        return Finding("calibration record", "failed", f"the camera was calibrated as mounted {record.mount!r}")
    T = invert(cell.mount.T_world_base) @ record.T_world_base
    off_m, off_deg = float(np.linalg.norm(T[:3, 3])), _turn_deg(T[:3, :3])
    if not (off_m <= BASE_M and off_deg <= BASE_DEG):
        return Finding(
            "calibration record",
            "failed",
            f"the robot's base is {off_m * 1e3:.1f} mm and {off_deg:.2f} deg from where it was when the camera was "
            "calibrated; calibrate again",
        )
    if not (record.held_out_mm <= HELD_OUT_MM and record.held_out_deg <= HELD_OUT_DEG):
        return Finding(
            "calibration record",
            "failed",
            f"its error was {record.held_out_mm:.1f} mm and {record.held_out_deg:.2f} deg, allowed are "
            f"{HELD_OUT_MM:g} mm and {HELD_OUT_DEG:g} deg; calibrate again",
        )
    text = f"{record.poses} poses, held-out error {record.held_out_mm:.1f} mm and {record.held_out_deg:.2f} deg"
    return Finding("calibration record", "ok", text)


def table_finding(frame: Frame, cell: Cell) -> Finding:
    """Look where the camera sees the table top; in the world it has to be z = 0."""
    if frame.T_world_camera is None:
        return Finding("table", "failed", "the frame does not say where the camera is")
    points = deproject(frame.depth, frame.camera)
    support = find_support(points, organised_normals(points, frame.camera), None, np.random.default_rng(0))
    if support is None:
        return Finding("table", "open", "the camera sees no surface that things could stand on")
    R, eye = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    normal = R @ support.plane.normal
    offset = support.plane.offset_m - float(normal @ eye)
    x, y = np.mean(np.array(cell.grasping_m)[:, :2], axis=0)
    tilt = _angle_deg(normal, np.array([0.0, 0.0, 1.0]))
    height = -(normal[0] * x + normal[1] * y + offset) / normal[2] if abs(normal[2]) > 0.1 else np.inf
    good = abs(height) <= TABLE_M and tilt <= TABLE_DEG
    text = f"the camera sees the table top at z = {height * 1e3:.1f} mm, tilted by {tilt:.1f} deg"
    return Finding("table", "ok" if good else "failed", text + ("" if good else "; calibrate the camera again"))


def arm_finding(frame: Frame, q: Float, opening_m: float, world: PlanningWorld) -> Finding:
    """Look whether the camera sees the arm where the joints say it is.

    Args:
        frame: Seen while the arm stood still.
        q: (6,) where the arm was [rad].
        opening_m: Of the gripper.
        world: With the arm where the cell has it.
    """
    if frame.T_world_camera is None:
        return Finding("arm in view", "failed", "the frame does not say where the camera is")
    camera, T = frame.camera, frame.T_world_camera
    stride = max(1, camera.width // _RAYS_ACROSS)
    v, u = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride].reshape(2, -1)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    expected = world.robot_along(q, opening_m, T[:3, 3], rays @ T[:3, :3].T)
    seen = frame.depth[v, u].astype(np.float64)
    on_arm = np.isfinite(expected) & (seen > 0)
    n = int(on_arm.sum())
    if n < ARM_POINTS:
        return Finding("arm in view", "open", f"too little of the arm is in view to tell ({n} points)")
    share = float((np.abs(seen - expected)[on_arm] <= ARM_M).mean())
    text = f"{share:.0%} of {n} points on the arm are within {ARM_M * 1e3:g} mm of where the joints say"
    good = share >= ARM_SHARE
    advice = "" if good else "; calibration, base pose or tool is wrong, or something hides the arm"
    return Finding("arm in view", "ok" if good else "failed", text + advice)


def enough(findings: Sequence[Finding]) -> bool:
    """Whether nothing failed, and the camera's pose was confirmed by something that it saw."""
    confirmed = any(f.state == "ok" and f.name in ("table", "arm in view") for f in findings)
    return confirmed and all(f.state != "failed" for f in findings)


def _angle_deg(a: Float, b: Float) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _turn_deg(R: Float) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _mm(T: Float) -> str:
    return "(" + ", ".join(f"{c * 1e3:.1f}" for c in T[:3, 3]) + ") mm"
