"""The wire to a Universal Robots controller: ur_rtde behind the few calls that the robot needs.

Motions are streamed as joint positions (servoJ), one each PERIOD_S: where this program dies or hangs, the arm comes to
rest at the last position that it was given, LOOKAHEAD_S of the motion ahead of where it is.

ur_rtde keeps returning what it heard last when nothing is heard any more, and connects again and sends its command
again by itself. What it says is believed only while the controller's clock goes on, without a gap.

References:
    ur_rtde 1.6: `sendCommand` returns False, and sends nothing, where the program does not run; `reconnect`.
    Universal Robots, "Dashboard server e-Series": a protective stop is not released within 5 s.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.lab.safety import Reason, Refusal, pose_from_ur, presses_too_hard, safety_refusal
from thinkgrasp.motion.trajectory import Trajectory

Float = NDArray[np.float64]

PERIOD_S = 0.008
"""Between two positions that are sent, and between two looks at safety status and force."""
LOOKAHEAD_S, GAIN = 0.1, 300
"""How servoJ smooths and follows; the maker's ranges are 0.03..0.2 s and 100..2000."""
_UNUSED = (0.5, 0.5)
"""Speed and acceleration of servoJ, which the controller takes and does not look at."""
SERVO_STOP_M_S2 = 10.0
OFF_TRACK_RAD = 0.30
"""A joint that lags behind by more is held up by something; at the highest speed the look-ahead alone makes 0.21."""
AT_GOAL_RAD, AT_REST_RAD_S = 0.01, 0.02
SETTLE_S = 2.0
STALE_S = 0.25
"""The controller's clock has to go on within this time, and by no more than this from one look to the next."""
UNLOCK_S, RELEASED_S = 7.0, 5.0
"""How long a protective stop is tried to be released, and may then take to be gone; and a program to start."""
NOT_STOPPED = "THE ARM COULD NOT BE TOLD TO STOP: use the emergency stop"
FULL_SPEED = 0.99
_PROGRAM_RUNS = 0b10
"""Bit of the robot's status."""


class Halted(Exception):
    """The arm was stopped, for a reason after which nothing may move without a person."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason: Reason = reason
        self.detail = detail


class Pressed(Exception):
    """The arm was stopped because it pressed on something.

    Args:
        travelled: (K, 6) positions of the motion so far, oldest first [rad].
    """

    def __init__(self, travelled: Float) -> None:
        super().__init__("the arm pressed on something")
        self.travelled = travelled


@dataclass(frozen=True, eq=False)
class ArmState:
    """What the controller said last."""

    q: Float
    """(6,) [rad]."""
    speed: Float
    """(6,) [rad/s]."""
    wrench: Float
    """(6,) at the TCP [N, Nm]."""
    safety_bits: int
    robot_mode: int
    speed_fraction: float
    """Where the speed slider on the pendant stands, 0..1."""
    program_runs: bool
    """Whether a program runs on the controller; without one the arm does not move."""
    clock_s: float
    """The controller's own clock."""


class URLink:
    """A connection to one controller.

    Args:
        host: Name or address of the controller.
        control: Whether to take control of the arm; without, it is only looked at.
        clock: Tells the time [s].
        sleep: Waits.

    Raises:
        MissingDependency: ur_rtde is not installed.
        ConfigError: Nothing answers, or it does not let itself be controlled.
    """

    def __init__(
        self,
        host: str,
        *,
        control: bool,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        try:
            import rtde_control  # pyright: ignore[reportMissingImports]
            import rtde_receive  # pyright: ignore[reportMissingImports]
        except ModuleNotFoundError as error:
            raise MissingDependency("ur_rtde", "ur", "the Universal Robots arm") from error
        self._host = host
        self._clock, self._sleep = clock, sleep
        self._control: Any = None
        self._receive: Any = None
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(host, 1 / PERIOD_S)
            if control:
                self._control = rtde_control.RTDEControlInterface(host, 1 / PERIOD_S)
        except (RuntimeError, ValueError) as error:
            self.close()
            needed = "reachable, powered on, and in remote control" if control else "reachable and powered on"
            raise ConfigError(
                f"the robot at {host} does not let itself be {'controlled' if control else 'read'}: {error}; "
                f"it must be {needed}"
            ) from error

    @property
    def controls(self) -> bool:
        """Whether the arm can be moved through this link."""
        return self._control is not None

    def state(self) -> ArmState:
        """Return what the controller said last.

        Raises:
            Halted: The connection is lost, or what it said holds numbers that are not finite.
        """
        receive = self._receive
        try:
            if not receive.isConnected():
                raise Halted("connection_lost", f"the connection to the robot at {self._host} is lost")
            state = ArmState(
                np.array(receive.getActualQ(), np.float64),
                np.array(receive.getActualQd(), np.float64),
                np.array(receive.getActualTCPForce(), np.float64),
                int(receive.getSafetyStatusBits()),
                int(receive.getRobotMode()),
                float(receive.getTargetSpeedFraction()),
                bool(int(receive.getRobotStatus()) & _PROGRAM_RUNS),
                float(receive.getTimestamp()),
            )
        except (RuntimeError, ValueError) as error:
            raise Halted("connection_lost", f"the robot at {self._host} cannot be read: {error}") from error
        if state.q.shape != (6,) or not np.isfinite(state.q).all():
            raise Halted("connection_lost", f"the robot at {self._host} reports joint angles that are none")
        if state.speed.shape != (6,) or state.wrench.shape != (6,):
            raise Halted("connection_lost", f"the robot at {self._host} reports no speeds or no forces")
        return state

    def fresh(self) -> ArmState:
        """Return something that the controller said after this call began.

        Raises:
            Halted: As `state`, or nothing new comes.
        """
        before, until = self.state().clock_s, self._clock() + STALE_S
        while True:
            state = self.state()
            if state.clock_s != before:
                return state
            if self._clock() > until:
                raise Halted("connection_lost", f"nothing new came from the robot at {self._host} for {STALE_S:g} s")
            self._sleep(PERIOD_S / 4)

    def ready(self) -> Refusal | None:
        """Say why the arm may not move now; None where it may.

        Raises:
            Halted: As `state`.
        """
        state = self.fresh()
        refusal = safety_refusal(state.safety_bits, state.robot_mode)
        if refusal is None and not state.speed_fraction >= FULL_SPEED:
            return Refusal(
                "robot_not_ready",
                f"the speed slider on the pendant stands at {state.speed_fraction:.0%}; set it to 100 %, the speeds "
                "are limited by the cell file",
            )
        if refusal is None and self.controls and not state.program_runs:
            return Refusal("robot_not_ready", "the program that moves the arm was stopped on the pendant")
        return refusal

    def tcp_pose(self) -> Float:
        """Return T_base_tcp (4, 4), with the tool that the controller believes in.

        Raises:
            Halted: The connection is lost, or the pose is none.
        """
        pose = np.array(self._call(self._receive.getActualTCPPose), np.float64)
        if pose.shape != (6,) or not np.isfinite(pose).all():
            raise Halted("connection_lost", f"the robot at {self._host} reports a TCP pose that is none")
        return pose_from_ur(pose)

    def tool(self) -> Float | None:
        """Return the controller's T_flange_tcp (4, 4); None where it is only looked at.

        Raises:
            Halted: The connection is lost.
        """
        if self._control is None:
            return None
        return pose_from_ur(np.array(self._call(lambda: self._control.getTCPOffset()), np.float64))

    def set_payload(self, mass_kg: float, center_m: tuple[float, float, float]) -> None:
        """Tell the controller what the flange carries.

        Raises:
            Halted: The connection is lost, or it does not take it.
        """
        if not self._call(lambda: self._control.setPayload(mass_kg, list(center_m))):
            raise self._lost("it does not take the payload")

    def follow(self, trajectory: Trajectory, *, force_n: float | None) -> None:
        """Move along a trajectory, looking at safety status, lag and force at each step.

        Args:
            trajectory: Starts where the arm is.
            force_n: More than this, above what it was at the start, stops the motion; None = not looked at.

        Raises:
            Pressed: It pressed on something and was stopped.
            Halted: It was stopped for another reason.
        """
        times = np.arange(1, int(np.ceil(trajectory.duration_s / PERIOD_S)) + 1) * PERIOD_S
        way = trajectory.sample(np.minimum(times, trajectory.duration_s))
        watch = _Watch(self, force_n)
        try:
            for i, q in enumerate(way):
                self._step(q)
                watch.look(q, way[: i + 1])
            self._settle(trajectory.end, watch, way)
        except BaseException as error:  # an interrupt from the keyboard too
            if self._stop_servo() or not isinstance(error, Halted):
                raise
            raise Halted(error.reason, f"{error.detail}; {NOT_STOPPED}") from error
        if not self._stop_servo():
            raise Halted("connection_lost", NOT_STOPPED)

    def _step(self, q: Float) -> None:
        started = self._call(self._control.initPeriod)
        if not self._call(lambda: self._control.servoJ(q.tolist(), *_UNUSED, PERIOD_S, LOOKAHEAD_S, GAIN)):
            raise self._lost("it does not take positions any more")
        self._call(lambda: self._control.waitPeriod(started))

    def _settle(self, end: Float, watch: _Watch, way: Float) -> None:
        for _ in range(round(SETTLE_S / PERIOD_S)):
            state = watch.look(end, way)
            if np.abs(state.q - end).max() < AT_GOAL_RAD and np.abs(state.speed).max() < AT_REST_RAD_S:
                return
            self._step(end)
        off = float(np.abs(self.state().q - end).max())
        raise Halted("off_track", f"the arm did not come to rest at the end of its motion; it is {off:.3f} rad away")

    def _lost(self, what: str) -> Halted:
        """Say why control was lost: by the safety status if that tells, else that the program ended."""
        state = self.state()
        refusal = safety_refusal(state.safety_bits, state.robot_mode)
        if refusal is not None:
            return Halted(refusal.reason, refusal.detail)
        return Halted("connection_lost", f"the robot at {self._host}: {what}; was its program stopped on the pendant?")

    def _call(self, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except (RuntimeError, ValueError) as error:
            raise Halted("connection_lost", f"the robot at {self._host} does not answer: {error}") from error

    def _stop_servo(self) -> bool:
        """Have the arm stop where it is; whether it does.

        A program that is paused, as in a safeguard stop, takes no command, and would go on to the last position when
        it is resumed: it is ended.
        """
        with contextlib.suppress(RuntimeError, ValueError):
            if self._control.servoStop(SERVO_STOP_M_S2):
                return True
        with contextlib.suppress(RuntimeError, ValueError), self._dashboard() as dashboard:
            dashboard.stop()
            return True
        with contextlib.suppress(Halted):
            return not self.fresh().program_runs
        return False

    @contextlib.contextmanager
    def _dashboard(self) -> Iterator[Any]:
        import dashboard_client  # pyright: ignore[reportMissingImports]

        dashboard: Any = dashboard_client.DashboardClient(self._host)
        dashboard.connect()
        try:
            yield dashboard
        finally:
            dashboard.disconnect()

    def unlock(self) -> None:
        """Release a protective stop and start the program again; only after a person has said so.

        Raises:
            Halted: It does not let itself be released.
        """
        try:
            with self._dashboard() as dashboard:
                dashboard.closeSafetyPopup()
                self._release(dashboard)
            self._wait_until(lambda state: safety_refusal(state.safety_bits, state.robot_mode) is None)
            if not self._control.reuploadScript():
                raise Halted("protective_stop", "the program that moves the arm cannot be sent to the robot")
            self._wait_until(lambda state: state.program_runs)
        except (RuntimeError, ValueError) as error:
            raise Halted("protective_stop", f"the protective stop cannot be released: {error}") from error
        refusal = self.ready()
        if refusal is not None:
            raise Halted(refusal.reason, refusal.detail)

    def _release(self, dashboard: Any) -> None:
        until = self._clock() + UNLOCK_S
        while True:
            try:
                return dashboard.unlockProtectiveStop()
            except RuntimeError:
                if self._clock() > until:
                    raise
                self._sleep(0.5)

    def _wait_until(self, done: Callable[[ArmState], bool]) -> None:
        """Wait until the controller says so, or not any longer; what it says then is looked at elsewhere."""
        until = self._clock() + RELEASED_S
        while not done(self.fresh()) and self._clock() <= until:
            self._sleep(0.05)

    def close(self) -> None:
        """Give control back; the arm stays where it is."""
        for interface, call in (
            (self._control, "stopScript"),
            (self._control, "disconnect"),
            (self._receive, "disconnect"),
        ):
            if interface is not None:
                try:
                    getattr(interface, call)()
                except (RuntimeError, ValueError):  # a connection that is gone is closed
                    continue


class _Watch:
    """Looks at the arm while it moves."""

    def __init__(self, link: URLink, force_n: float | None) -> None:
        self._link = link
        self._force_n = force_n
        state = link.state()
        self._wrench = state.wrench
        self._clock_s, self._since = state.clock_s, link._clock()

    def look(self, q: Float, way: Float) -> ArmState:
        """Return the state, or stop: `q` is where the arm should be, `way` where it has been sent so far."""
        link, state = self._link, self._link.state()
        refusal = safety_refusal(state.safety_bits, state.robot_mode)
        if refusal is not None:
            raise Halted(refusal.reason, refusal.detail)
        if not state.program_runs:
            raise link._lost("its program has ended")
        now, gap_s = link._clock(), state.clock_s - self._clock_s
        if not 0 <= gap_s <= STALE_S:
            raise Halted("connection_lost", f"nothing was heard from the robot for {gap_s:.2f} s of its clock")
        if gap_s > 0:
            self._clock_s, self._since = state.clock_s, now
        elif now - self._since > STALE_S:
            raise Halted("connection_lost", f"nothing new came from the robot for {now - self._since:.2f} s")
        if self._force_n is not None and presses_too_hard(state.wrench, self._wrench, self._force_n):
            raise Pressed(way)
        lag = float(np.abs(state.q - q).max())
        if lag > OFF_TRACK_RAD:
            raise Halted("off_track", f"a joint is {lag:.2f} rad behind; something holds the arm up")
        return state
