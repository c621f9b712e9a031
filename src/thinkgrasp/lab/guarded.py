"""The rules for any robot plug-in: a grasp is looked at, shown and agreed to before the robot is told."""

from __future__ import annotations

from thinkgrasp.errors import InputError
from thinkgrasp.interfaces import Robot
from thinkgrasp.lab.cell import Cell
from thinkgrasp.lab.journal import Journal
from thinkgrasp.lab.person import Motion, Person
from thinkgrasp.lab.safety import Reason, check_grasp, grasp_in_world
from thinkgrasp.types import Frame, Grasp, Outcome


class GuardedRobot:
    """A robot that does not ask by itself.

    Speed, force and the way of each motion are its own business; it is asked for once for each grasp.

    Args:
        robot: Executes what is agreed to.
        person: Asked before each grasp.
        journal: Told what was asked, answered, and what became of it.
        cell: Where grasping is allowed; None = everywhere.
        dry_run: Tell, and do not execute.
    """

    def __init__(
        self, robot: Robot, *, person: Person, journal: Journal, cell: Cell | None = None, dry_run: bool = False
    ) -> None:
        self.robot = robot
        self._stopped: Reason | None = None
        self.motion = getattr(robot, "motion", None)
        self.T_world_flange = getattr(robot, "T_world_flange", None)
        self._person, self._journal, self._cell, self._dry_run = person, journal, cell, dry_run

    @property
    def halted(self) -> str | None:
        """Why nothing moves any more, by the person or the robot itself; None while it does."""
        return self._stopped or getattr(self.robot, "halted", None)

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        """Have the grasp carried out if the rules and the person allow it.

        Raises:
            InputError: The frame's camera pose is unknown.
        """
        T_world_tcp = grasp_in_world(grasp, frame)
        if T_world_tcp is None:
            raise InputError("a robot needs the camera's pose: T_world_camera is missing in the frame")
        if self.halted is not None:
            return Outcome(False, self.halted)
        refusal = check_grasp(grasp, T_world_tcp, self._cell)
        if refusal is not None:
            return self._end(Outcome(False, refusal.reason), refusal.detail)
        at = ", ".join(f"{c:.3f}" for c in T_world_tcp[:3, 3])
        motion = Motion(
            "to a grasp and on to the bin", f"closing from {grasp.width_m * 1e3:.0f} mm at ({at}) m in the world"
        )
        if self._dry_run:
            self._person.tell(f"would move {motion.name}: {motion.detail}")
            return self._end(Outcome(False, "dry_run"))
        answer = self._person.allows(motion)
        self._journal.note("asked", name=motion.name, detail=motion.detail, answer=answer)
        if answer == "stop":
            self._stopped = "stopped_by_person"
            return self._end(Outcome(False, "stopped_by_person"))
        if answer == "no":
            return self._end(Outcome(False, "refused_by_person"))
        return self._end(self.robot.execute(grasp, frame))

    def _end(self, outcome: Outcome, detail: str = "") -> Outcome:
        self._journal.note("outcome", success=outcome.success, reason=outcome.reason, detail=detail)
        if detail:
            self._person.tell(f"{outcome.reason.replace('_', ' ')}: {detail}")
        return outcome
