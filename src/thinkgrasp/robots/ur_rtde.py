"""A real UR5e with a Robotiq 2F-85: the attempt of the simulated robot, with a person and rules in between.

Open, approach, close, lift, verify, carry to the bin, verify again, release, go home. Motions are planned against the
perceived cloud of the frame that the grasp was found in. Each is slowed down to the cell's limits, checked sample by
sample, shown to the person, and only then made. What went wrong is a named reason (`thinkgrasp.lab.safety.Reason`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.lab import agreement
from thinkgrasp.lab.cell import Cell, load_cell
from thinkgrasp.lab.journal import Journal
from thinkgrasp.lab.person import AtTheKeyboard, Person
from thinkgrasp.lab.safety import HALTS, Reason, check_grasp, check_motion, describe, grasp_in_world, slowed_to
from thinkgrasp.motion.robotiq_2f85 import STROKE_M
from thinkgrasp.motion.trajectory import Trajectory, time_path
from thinkgrasp.robots.pinch import MAX_RETREAT_M, over_bin, perceived_cloud, retreat_for_arc, without_taken
from thinkgrasp.robots.robotiq import Counts, GripperError, GripperState, RobotiqGripper
from thinkgrasp.robots.ur_link import Halted, Pressed, URLink
from thinkgrasp.robots.ur_moves import AskedArm, Refused
from thinkgrasp.types import Frame, Grasp, Outcome

try:
    from thinkgrasp.motion.arm import ArmMotion, GraspMotion
    from thinkgrasp.motion.collision import PlanningWorld
except ModuleNotFoundError as _error:
    raise MissingDependency("mujoco-core", "ur", "planning the arm's motions") from _error

Float = NDArray[np.float64]

_AWAY_RAD = 0.1
"""An arm this far from home may be taken for a thing by the camera, and hides others."""
_BACK_OUT_SPEED = 0.3
"""Share of the joint speed on the way back from what the arm pressed on."""


class URRobot:
    """Executes grasps with a real arm.

    Args:
        cell: Layout, limits and addresses, or the file with them.
        person: Asked before each motion; by default at the keyboard.
        journal: Told everything that was about to move, what was answered, and what became of it.
        dry_run: Plan and show; the arm is only looked at, the gripper not even that.
        record: How the camera's pose was found.
        planner: Finds the arm's paths: "rrt_connect", or a planner of the OMPL such as "RRTstar".
        clock: Tells the time [s].
        sleep: Waits.

    Raises:
        ConfigError: The cell cannot be used; or robot or gripper do not answer.
        MissingDependency: ur_rtde or MuJoCo (for planning) is not installed.
    """

    def __init__(
        self,
        *,
        cell: Cell | str | Path,
        person: Person | None = None,
        journal: Journal | None = None,
        dry_run: bool = False,
        record: agreement.CalibrationRecord | None = None,
        planner: str = "rrt_connect",
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.cell = cell if isinstance(cell, Cell) else load_cell(cell)
        self.person = person or AtTheKeyboard()
        self.journal = journal or Journal()
        self.dry_run = dry_run
        self.record = record
        self.halted: Reason | None = None
        """Why nothing moves any more; None while it does."""
        self.motion = ArmMotion(
            PlanningWorld(self.cell.statics, map=self.cell.height_map, mount=self.cell.mount),
            planner=planner,
            limits=self.cell.joint_limits,
            straight_speed=1.0,
            seen_at=self.cell.robot.home_rad,
        )
        self._checked = False
        self._cloud = np.zeros((0, 3))
        self.link = URLink(self.cell.robot.host, control=not dry_run, clock=clock, sleep=sleep)
        try:
            self.gripper = None if dry_run else self._connect_gripper(sleep)
        except ConfigError:
            self.link.close()
            raise
        self.arm = AskedArm(self.cell, self.person, self.journal, self.link, self.gripper)

    def _connect_gripper(self, sleep: Callable[[float], None]) -> RobotiqGripper:
        part = self.cell.robot.gripper
        try:
            return RobotiqGripper(
                part.host or self.cell.robot.host,
                part.port,
                counts=Counts(part.model, part.open_count, part.closed_count),
                force_n=part.force_n,
                speed_m_s=part.speed_m_s,
                sleep=sleep,
            )
        except GripperError as error:
            raise ConfigError(str(error)) from error

    def close(self) -> None:
        """Leave arm and gripper as they are."""
        self.link.close()
        if self.gripper is not None:
            self.gripper.close()

    def T_world_flange(self) -> Float:  # noqa: N802
        """Return where the arm's flange is (4, 4), for a camera that it carries.

        Raises:
            InputError: The robot does not say.
        """
        try:
            return self.cell.flange(self.link.fresh().q)
        except Halted as halt:
            raise InputError(f"where the camera is cannot be told: {halt.detail}") from halt

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        """Carry out a grasp given in the frame's camera coordinates.

        Returns:
            "held" when the thing was let go over the bin; else a named reason. After one of
            `thinkgrasp.lab.safety.HALTS` the robot is `halted`, and says so to every further grasp.

        Raises:
            InputError: The frame's camera pose is unknown.
        """
        T_world_tcp = grasp_in_world(grasp, frame)
        if T_world_tcp is None:
            raise InputError("a robot needs the camera's pose: T_world_camera is missing in the frame")
        if self.halted is not None:
            return Outcome(False, self.halted)
        reason, detail = self._concluded(lambda: self._attempt(grasp, T_world_tcp, frame))
        outcome = Outcome(True, "held") if reason is None else Outcome(False, reason)
        self.journal.note("outcome", success=outcome.success, reason=outcome.reason, detail=detail)
        return outcome

    def prepare(self, frame: Frame) -> None:
        """Bring the arm home if it is elsewhere and the person agrees: there it waits while the camera looks.

        Args:
            frame: Seen with the arm where it is; what it shows is kept away from.

        Raises:
            InputError: The frame's camera pose is unknown.
        """
        reason, detail = self._concluded(lambda: self._come_home(frame))
        if reason is not None:
            self.journal.note("prepared", reason=reason, detail=detail)

    def _concluded(self, attempt: Callable[[], Reason | None]) -> tuple[Reason | None, str]:
        """Make an attempt, and return and tell why it came to no good end."""
        self.arm.moved = False
        reason: Reason | None
        detail = ""
        try:
            reason = attempt()
        except Refused as end:
            reason, detail = end.reason, end.detail
            self.halted = reason if end.away else self.halted
        except Halted as halt:
            reason, detail = self._halt(halt)
        except GripperError as error:
            reason, detail = self._halt(Halted(error.reason, str(error)))
        if reason is not None and detail:
            self.person.tell(f"{reason.replace('_', ' ')}: {detail}")
        return reason, detail

    # -- one attempt -------------------------------------------------------------------------------------------------

    def _attempt(self, grasp: Grasp, T_world_tcp: Float, frame: Frame) -> Reason | None:
        refusal = check_grasp(grasp, T_world_tcp, self.cell)
        if refusal is not None:
            raise Refused(refusal.reason, refusal.detail)
        self._check_ready()
        self._check_agreement(frame)
        away = self._away_rad()
        if away > _AWAY_RAD and not self.dry_run:
            raise Halted("not_at_home", f"the arm is {away:.2f} rad from home, where it waits while the camera looks")
        opening = min(grasp.width_m, STROKE_M)
        retreat = retreat_for_arc(T_world_tcp, opening)
        if retreat > MAX_RETREAT_M:
            raise Refused(
                "unreachable", f"the fingertips' arc would need {retreat * 1e3:.0f} mm of room over the table"
            )
        T_world_tcp = T_world_tcp.copy()
        T_world_tcp[:3, 3] -= retreat * T_world_tcp[:3, 2]
        self._cloud = cloud = perceived_cloud(frame)
        plan = self.motion.plan_grasp(self.link.state().q, T_world_tcp, opening, cloud)
        if isinstance(plan, str):
            raise Refused("unreachable", f"no motion to the grasp: {plan}")
        self._rehearse(plan, T_world_tcp, opening, cloud)
        if self.dry_run:
            return "dry_run"
        return self._take(plan, T_world_tcp, opening, cloud)

    def _take(self, plan: GraspMotion, T_world_tcp: Float, opening: float, cloud: Float) -> Reason | None:
        slow, fast = self.cell.limits.approach_speed_m_s, self.cell.limits.tcp_speed_m_s
        self.arm.activate_gripper()
        self.arm.open(opening, f"open the gripper to {opening * 1e3:.0f} mm")
        try:
            self.arm.move("to the pre-grasp", plan.to_pregrasp, fast)
            self.arm.move("straight in", plan.approach, slow)
        except Pressed as stop:
            return self._back_out(stop, cloud)
        gripped = self.arm.close_gripper()
        try:
            self.arm.move("straight up", plan.lift, slow)
            if not gripped.has_object or not self.arm.still_holds(gripped):
                self.arm.open(STROKE_M, "open the gripper")
                self._go_home(cloud)
                return "missed" if not gripped.has_object else "slipped"
            return self._deliver(gripped, without_taken(cloud, T_world_tcp), float(T_world_tcp[2, 3]))
        except Pressed as stop:
            self.arm.open(STROKE_M, "open the gripper and let go")
            return self._back_out(stop, cloud)

    def _deliver(self, gripped: GripperState, cloud: Float, taken_at_z: float) -> Reason | None:
        way = self._way_to_bin(self.link.state().q, gripped.opening_m, cloud, taken_at_z)
        if isinstance(way, str):
            self.arm.open(STROKE_M, "open the gripper, as no way leads to the bin, and let go")
            self._go_home(cloud)
            return "unreachable"
        self.arm.move("to the bin", way, self.cell.limits.tcp_speed_m_s)
        held = self.arm.still_holds(gripped)
        self.arm.open(STROKE_M, "open the gripper over the bin" if held else "open the gripper")
        self._go_home(cloud)
        return None if held else "slipped"

    def _come_home(self, frame: Frame) -> Reason | None:
        away = self._away_rad()
        if away <= _AWAY_RAD:
            return None
        self.person.tell(f"the arm is {away:.2f} rad from home, where it has to wait while the camera looks")
        if self.dry_run:
            return "dry_run"
        self._check_ready()
        self._check_agreement(frame)
        self._cloud = perceived_cloud(frame)
        self.motion.seen_at = self.link.state().q
        try:
            self._go_home(self._cloud)
        finally:
            self.motion.seen_at = self.cell.home
        return None

    def _away_rad(self) -> float:
        return float(np.abs(self.link.fresh().q - self.cell.home).max())

    # -- before the first move ---------------------------------------------------------------------------------------

    def _check_ready(self) -> None:
        if not self.dry_run:
            self.arm.check_ready()
        elif not_ready := self.link.ready():
            self.person.tell(f"the arm could not move now: {not_ready.detail}")

    def _check_agreement(self, frame: Frame) -> None:
        """Look once whether camera, arm and tool agree; nothing moves before they do."""
        if self._checked:
            return
        state, T_base_tcp = self.link.state(), self.link.tcp_pose()
        findings = agreement.all_findings(
            state.q,
            T_base_tcp,
            self.link.tool(),
            frame,
            cell=self.cell,
            record=self.record,
            opening_m=self.arm.opening_m,
            world=self.motion.world,
        )
        for finding in findings:
            self.person.tell(finding.line())
            self.journal.note("check", name=finding.name, state=finding.state, detail=finding.detail)
        if not agreement.enough(findings):
            failed = [f.name for f in findings if f.state == "failed"] or ["table", "arm in view"]
            raise Halted("checks_failed", f"not agreed upon: {', '.join(failed)}; nothing moves")
        self._checked = True

    def _rehearse(self, plan: GraspMotion, T_world_tcp: Float, opening: float, cloud: Float) -> None:
        """Check every motion up to the bin before the first one is made; in a dry run, tell them."""
        slow, fast = self.cell.limits.approach_speed_m_s, self.cell.limits.tcp_speed_m_s
        to_bin = self._way_to_bin(plan.lift.end, opening, without_taken(cloud, T_world_tcp), float(T_world_tcp[2, 3]))
        if isinstance(to_bin, str):
            raise Refused("unreachable", f"no motion from the grasp to the bin: {to_bin}")
        at = ", ".join(f"{c:.3f}" for c in T_world_tcp[:3, 3])
        told = [f"would close from {opening * 1e3:.0f} mm at ({at}) m in the world"]
        q = self.link.state().q
        parts = (
            ("to the pre-grasp", plan.to_pregrasp, fast),
            ("straight in", plan.approach, slow),
            ("straight up", plan.lift, slow),
            ("to the bin", to_bin, fast),
        )
        for name, trajectory, speed in parts:
            motion = slowed_to(trajectory, self.cell, tcp_speed_m_s=speed)
            refusal = check_motion(motion, q, self.cell, tcp_speed_m_s=speed)
            self.journal.note("planned", name=name, duration_s=motion.duration_s, end_rad=motion.end.tolist())
            if refusal is not None:
                raise Refused(refusal.reason, f"{name}: {refusal.detail}")
            told.append(f"would move {name}: {describe(motion, self.cell)}")
            q = motion.end
        if self.dry_run:
            for line in told:
                self.person.tell(line)

    def _way_to_bin(self, q: Float, opening_m: float, cloud: Float, taken_at_z_m: float) -> Trajectory | str:
        return self.motion.plan_to_poses(q, over_bin(self.cell.bin_box, taken_at_z_m), opening_m, cloud)

    # -- ways back -----------------------------------------------------------------------------------------------------

    def _go_home(self, cloud: Float) -> None:
        q = self.link.state().q
        way = self.motion.plan_to(q, self.cell.home, self.arm.opening_m, cloud)
        if isinstance(way, str):
            raise Halted("no_way_home", f"no way leads home ({way}); move the arm home by hand")
        try:
            self.arm.move("home", way, self.cell.limits.tcp_speed_m_s)
        except Pressed as stop:
            raise Halted("no_way_home", "the arm pressed on something on its way home; move it there by hand") from stop

    def _back_out(self, stop: Pressed, cloud: Float) -> Reason:
        """Leave what the arm pressed on by the way it came, at low speed, then go home."""
        now = self.link.state().q
        nearest = int(np.argmin(np.abs(stop.travelled - now).max(axis=1)))  # the arm lags behind what it was told
        way = np.concatenate([now[None], stop.travelled[nearest::-1]])
        back = time_path(way, self.cell.joint_limits, speed=_BACK_OUT_SPEED)
        self.arm.move("back the way it came", back, self.cell.limits.approach_speed_m_s, felt=False)
        self._go_home(cloud)
        return "collision"

    def _halt(self, halt: Halted) -> tuple[Reason, str]:
        """Stay still; a protective stop is released if the person says so, and only then is the robot not halted."""
        self.journal.note("halted", reason=halt.reason, detail=halt.detail)
        if halt.reason != "protective_stop":
            self.halted = halt.reason if halt.reason in HALTS else self.halted
            return halt.reason, halt.detail
        self.halted = "protective_stop"
        self.person.tell(f"PROTECTIVE STOP: {halt.detail}")
        if self.person.confirms("Release it? First look why it stopped, and that nothing is clamped."):
            self.journal.note("unlock")
            try:
                self.link.unlock()
                if self.arm.moved:  # else nothing was looked at yet, and the arm is where it was
                    self.arm.open(STROKE_M, "open the gripper and let go of what it may hold")
                    self._go_home(self._cloud)
                self.halted = None
            except (Halted, Refused, GripperError) as again:
                return halt.reason, f"{halt.detail}; released, but then: {getattr(again, 'detail', again)}"
        return halt.reason, halt.detail
