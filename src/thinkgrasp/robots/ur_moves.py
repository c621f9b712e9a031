"""Single motions of a real arm and its gripper: slowed down, checked, shown to the person, and only then made."""

from __future__ import annotations

import numpy as np

from thinkgrasp.lab.cell import Cell
from thinkgrasp.lab.journal import Journal
from thinkgrasp.lab.person import Motion, Person
from thinkgrasp.lab.safety import START_TOLERANCE_RAD, Reason, check_motion, describe, slowed_to
from thinkgrasp.motion.robotiq_2f85 import STROKE_M
from thinkgrasp.motion.trajectory import Trajectory
from thinkgrasp.robots.robotiq import GripperState, RobotiqGripper
from thinkgrasp.robots.ur_link import Halted, Pressed, URLink

_AS_TOLD_M = 0.01
"""How far from what they were told the fingers may stand."""


class Refused(Exception):
    """A rule or the person said no to a motion, or to the attempt before its first one.

    Args:
        reason: By name.
        detail: In words.
        away: Whether the arm has moved and stands somewhere on its way: then nothing more may move.
    """

    def __init__(self, reason: Reason, detail: str, *, away: bool = False) -> None:
        super().__init__(detail)
        self.reason: Reason = reason
        self.detail = f"{detail}; the arm stays where it is" if away else detail
        self.away = away


class AskedArm:
    """Moves the arm or the fingers once, if the rules and the person allow it.

    Args:
        cell: Box and limits.
        person: Asked before each motion.
        journal: Told what was asked, answered and made.
        link: To the arm.
        gripper: None where nothing is to be moved.
    """

    def __init__(
        self, cell: Cell, person: Person, journal: Journal, link: URLink, gripper: RobotiqGripper | None
    ) -> None:
        self._cell, self._person, self._journal, self._link, self._gripper = cell, person, journal, link, gripper
        self.moved = False
        """Whether the arm was moved since this was last set to False."""
        self.opening_m = STROKE_M
        """Of the fingers, as they were last seen."""

    def check_ready(self) -> None:
        """Raise Halted where the arm may not move now."""
        not_ready = self._link.ready()
        if not_ready is not None:
            raise Halted(not_ready.reason, not_ready.detail)

    def move(self, name: str, trajectory: Trajectory, tcp_speed_m_s: float, *, felt: bool = True) -> None:
        """Move along a trajectory, as slowly as the limits ask for.

        Args:
            name: For the person.
            trajectory: Starts where the arm is.
            tcp_speed_m_s: Allowed of fingertips and flange.
            felt: Whether force stops it.

        Raises:
            Refused: A rule or the person says no.
            Pressed: The arm pressed on something and was stopped.
            Halted: It was stopped for another reason, or may not move.
        """
        motion = slowed_to(trajectory, self._cell, tcp_speed_m_s=tcp_speed_m_s)
        refusal = check_motion(motion, self._link.state().q, self._cell, tcp_speed_m_s=tcp_speed_m_s)
        if refusal is not None:
            self._journal.note("refused", name=name, reason=refusal.reason, detail=refusal.detail)
            raise Refused(refusal.reason, f"{name}: {refusal.detail}", away=self.moved)
        if motion.duration_s == 0:
            return
        self._ask(Motion(name, describe(motion, self._cell)))
        self.check_ready()
        moved_rad = float(np.abs(self._link.state().q - motion.start).max())
        if moved_rad > START_TOLERANCE_RAD:
            detail = f"{name}: the arm was moved by {moved_rad:.3f} rad while the question was open"
            raise Refused("jump", detail, away=self.moved)
        self.moved = True
        try:
            self._link.follow(motion, force_n=self._cell.limits.force_n if felt else None)
        except Pressed:
            self._journal.note("pressed", name=name)
            raise
        self._journal.note("moved", name=name, q_rad=np.round(self._link.state().q, 4).tolist())

    def _ask(self, motion: Motion) -> None:
        answer = self._person.allows(motion)
        self._journal.note("asked", name=motion.name, detail=motion.detail, answer=answer)
        if answer == "stop":
            raise Halted("stopped_by_person", f"the person said stop: {motion.name}")
        if answer == "no":
            raise Refused("refused_by_person", f"the person said no: {motion.name}", away=self.moved)

    # -- gripper: all raise GripperError, and Refused or Halted where the person says so ------------------------------

    @property
    def _fingers(self) -> RobotiqGripper:
        if self._gripper is None:
            raise Halted("robot_not_ready", "a dry run has no gripper")
        return self._gripper

    def activate_gripper(self) -> None:
        """Activate the gripper where it is not, and tell the controller what it weighs."""
        part = self._cell.robot.gripper
        if not self._fingers.is_active():
            self._ask(Motion("activate the gripper", "the fingers move to both ends"))
            self._fingers.activate()
        self._link.set_payload(part.mass_kg, part.center_of_mass_m)

    def open(self, opening_m: float, name: str) -> None:
        """Open the fingers to an opening."""
        self._ask(Motion(name, f"fingers to {opening_m * 1e3:.0f} mm"))
        state = self._seen(name, self._fingers.move(opening_m))
        if abs(state.opening_m - opening_m) > _AS_TOLD_M:
            at, told = f"{state.opening_m * 1e3:.0f} mm", f"{opening_m * 1e3:.0f} mm"
            raise Halted("gripper_fault", f"the gripper was told to open to {told} and stands at {at}")

    def close_gripper(self) -> GripperState:
        """Close the fingers until something stops them."""
        self._ask(Motion("close the gripper", f"with {self._cell.robot.gripper.force_n:.0f} N"))
        return self._seen("close", self._fingers.grip())

    def still_holds(self, gripped: GripperState) -> bool:
        """Whether the fingers hold what they held then."""
        return self._fingers.still_holds(gripped)

    def _seen(self, name: str, state: GripperState) -> GripperState:
        self.opening_m = state.opening_m
        self._journal.note("gripper", name=name, opening_m=state.opening_m, seen=state.seen.name)
        return state
