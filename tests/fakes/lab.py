"""A lab that is the simulator: the interfaces of ur_rtde, the gripper's socket and pyrealsense2 over a MuJoCo world."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from fakes.realsense_module import FakeRealSense
from fakes.robotiq_server import FakeGripperServer
from scipy.spatial.transform import Rotation

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.lab.cell import Cell
from thinkgrasp.lab.person import Answer, Motion
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.motion.robotiq_2f85 import STROKE_M, flange_to_tip
from thinkgrasp.robots.robotiq import Counts
from thinkgrasp.sim.views import CameraView, default_view
from thinkgrasp.sim.world import TIMESTEP_S, World
from thinkgrasp.types import Frame

PERIOD_S = 0.008
NORMAL, PROTECTIVE, SAFEGUARD, EMERGENCY = 0b1, 0b100, 0b10000, 0b1000000


class WorldFingers:
    """The simulated gripper as a mechanism behind the socket: 20 ms of the world at each look."""

    def __init__(self, world: World, counts: Counts | None = None) -> None:
        self.world, self.counts = world, counts or Counts()
        self.goal = self.told = world.opening()
        self.still = 0
        self.moving = False

    def go(self, position: int) -> None:
        self.goal, self.told = self.counts.opening(position), self.world.opening()
        self.moving, self.still = True, 0

    def stop(self) -> None:
        self.moving = False

    def tick(self) -> None:
        if not self.moving:
            return
        before = self.world.opening()
        self.told += float(np.clip(self.goal - self.told, -0.003, 0.003))
        self.world.command_gripper(self.told)
        self.world.step(round(0.02 / TIMESTEP_S))
        now = self.world.opening()
        stopped = abs(now - before) < 4e-5 and abs(self.told - now) > 2e-3
        self.still = self.still + 1 if stopped else 0
        if self.still >= 3 or (self.told == self.goal and abs(now - before) < 4e-5):
            self.moving = False
            if self.goal == 0.0:
                self.world.command_gripper(0.0)
                self.world.step(round(0.15 / TIMESTEP_S))

    @property
    def position(self) -> int:
        return self.counts.position(self.world.opening())

    @property
    def seen(self) -> int:
        if self.moving:
            return 0
        return 2 if self.goal == 0.0 and self.world.opening() > 0.002 else 3


class FakeLab:
    """A UR5e with a gripper and a camera over a table, and what can go wrong with them.

    Attributes:
        bits, mode, connected, running, slider: What the controller says.
        tcp: The controller's tool on the flange.
        after: Called with the number of periods that passed; where faults are put in.
        moved: How many positions were sent.
        unlocked: How often a protective stop was released.
        lag_s: By how much the arm follows late, as servoJ does with its look-ahead.
        time_s: What `clock` says; goes on by what is slept and a little by itself.
        gap_s: How long the controller was not heard, as when the vendor's module connects again by itself.
    """

    def __init__(self, world: World, view: CameraView | None = None, *, noise: str | None = "l515") -> None:
        self.world = world
        self.view = view or default_view("l515", (320, 240))
        self.bits, self.mode, self.connected, self.running, self.slider = NORMAL, 7, True, True, 1.0
        self.tcp = flange_to_tip(0.0)
        self.after: Callable[[int], None] = lambda periods: None
        self.periods = self.moved = self.unlocked = self.stops = 0
        self.force_n = 0.0
        self.frozen_clock = False
        self.lag_s = 0.0
        self.controlled = False
        self.time_s, self.gap_s, self.stamp_s, self.said = 0.0, 0.0, 0.0, 0
        self.stopped_at_s = -np.inf
        self._last: np.ndarray | None = None
        self.gripper = FakeGripperServer(WorldFingers(world))
        self.camera = SimulatedCamera(world, self.view, noise=noise)
        self.realsense = FakeRealSense(self._look, self.view.intrinsics)

    def close(self) -> None:
        self.gripper.close()

    def _look(self) -> Frame:
        with self.gripper.lock:
            return self.camera.read()

    def clock(self) -> float:
        self.time_s += 0.001
        return self.time_s

    def sleep(self, seconds: float) -> None:
        self.time_s += seconds

    def protective_stop(self) -> None:
        self.bits, self.running, self.stopped_at_s = PROTECTIVE, False, self.time_s

    def takes_commands(self) -> bool:
        """A program that is ended or paused takes none: the vendor's module says False then, and does nothing."""
        return self.running and self.bits & (PROTECTIVE | SAFEGUARD | EMERGENCY) == 0

    # -- ur_rtde -----------------------------------------------------------------------------------------------------

    def modules(self) -> dict[str, ModuleType]:
        """What to import instead of the vendors' modules."""
        made = {name: ModuleType(name) for name in ("rtde_control", "rtde_receive", "dashboard_client")}
        lab = self

        class Control:
            def __init__(self, hostname: str, frequency: float = -1.0, flags: int = 1) -> None:
                lab.refuse_unless_connected()
                lab.controlled = True

        class Receive:
            def __init__(self, hostname: str, frequency: float = -1.0) -> None:
                lab.refuse_unless_connected()

        class Dashboard:
            def __init__(self, hostname: str, port: int = 29999) -> None: ...

        for cls, names in ((Control, CONTROL), (Receive, RECEIVE), (Dashboard, DASHBOARD)):
            for name in names:
                setattr(cls, name, lab.method(f"{cls.__name__.lower()}_{name}"))
        made["rtde_control"].RTDEControlInterface = Control  # type: ignore[attr-defined]
        made["rtde_receive"].RTDEReceiveInterface = Receive  # type: ignore[attr-defined]
        made["dashboard_client"].DashboardClient = Dashboard  # type: ignore[attr-defined]
        made["pyrealsense2"] = self.realsense.module()
        return made

    def refuse_unless_connected(self) -> None:
        if not self.connected:
            raise RuntimeError("Could not connect to: lab at 30004, verify the IP")

    def method(self, name: str) -> Callable[..., Any]:
        def call(_self: Any, *args: Any) -> Any:
            if not self.connected and not name.startswith("receive_") and not name.endswith(("disconnect", "Period")):
                raise RuntimeError("Could not recover from losing connection to robot!")
            with self.gripper.lock:
                return getattr(self, name)(*args)

        return call

    def control_initPeriod(self) -> timedelta:  # noqa: N802
        return timedelta()

    def control_waitPeriod(self, started: timedelta) -> None:  # noqa: N802
        self.world.step(round(PERIOD_S / TIMESTEP_S))
        self.periods += 1
        self.after(self.periods)
        if not self.takes_commands():
            self.world.command(self.world.joints(), np.zeros(6))

    def control_servoJ(self, q: list[float], *rest: float) -> bool:  # noqa: N802
        assert len(rest) == 5
        if not self.takes_commands():
            return False
        self.moved += 1
        now = np.array(q)
        last = self.world.joints() if self._last is None else self._last
        if self.lag_s:
            now = last + (now - last) * PERIOD_S / self.lag_s
        self.world.command(now, (now - last) / PERIOD_S)
        self._last = now
        return True

    def control_servoStop(self, deceleration: float) -> bool:  # noqa: N802
        if not self.takes_commands():
            return False
        self.stops += 1
        self.world.command(self.world.joints(), np.zeros(6))
        self._last = None
        return True

    def control_getTCPOffset(self) -> list[float]:  # noqa: N802
        return as_pose(self.tcp)

    def control_setPayload(self, mass: float, center: list[float]) -> bool:  # noqa: N802
        return self.takes_commands()

    def control_reuploadScript(self) -> bool:  # noqa: N802
        self.running = True
        return True

    def control_stopScript(self) -> None:  # noqa: N802
        self.running = False

    def control_disconnect(self) -> None: ...

    def receive_disconnect(self) -> None: ...

    def receive_isConnected(self) -> bool:  # noqa: N802
        return self.connected

    def receive_getActualQ(self) -> list[float]:  # noqa: N802
        return self.world.joints().tolist()

    def receive_getActualQd(self) -> list[float]:  # noqa: N802
        return self.world.data.qvel[:6].tolist()

    def receive_getActualTCPForce(self) -> list[float]:  # noqa: N802
        return [self.force_n + self.world.collision_force(self.world.held()), 0, 0, 0, 0, 0]

    def receive_getActualTCPPose(self) -> list[float]:  # noqa: N802
        return as_pose(ur5e.forward(self.world.joints()) @ self.tcp)

    def receive_getSafetyStatusBits(self) -> int:  # noqa: N802
        return self.bits

    def receive_getRobotMode(self) -> int:  # noqa: N802
        return self.mode

    def receive_getTargetSpeedFraction(self) -> float:  # noqa: N802
        return self.slider

    def receive_getTimestamp(self) -> float:  # noqa: N802
        if not self.frozen_clock:
            self.said += 1  # the stream goes on while the arm stands still
            self.stamp_s = 0.002 * self.said + self.world.time_s + self.gap_s
        return self.stamp_s

    def receive_getRobotStatus(self) -> int:  # noqa: N802
        return 0b01 | self.running << 1

    def dashboard_connect(self) -> None: ...

    def dashboard_closeSafetyPopup(self) -> None: ...  # noqa: N802

    def dashboard_unlockProtectiveStop(self) -> None:  # noqa: N802
        if self.time_s < self.stopped_at_s + 5.0:
            raise RuntimeError("Unlock protective stop failure: Cannot unlock until 5s after occurrence")
        self.unlocked += 1
        self.bits = NORMAL

    def dashboard_stop(self) -> None:
        if not self.running:
            raise RuntimeError("Failed to execute: stop")
        self.running = False

    def dashboard_disconnect(self) -> None: ...


CONTROL = tuple(n.removeprefix("control_") for n in vars(FakeLab) if n.startswith("control_"))
RECEIVE = tuple(n.removeprefix("receive_") for n in vars(FakeLab) if n.startswith("receive_"))
DASHBOARD = tuple(n.removeprefix("dashboard_") for n in vars(FakeLab) if n.startswith("dashboard_"))


def as_pose(T: np.ndarray) -> list[float]:
    return [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()]


def cell_data(port: int = 63352, **changes: Any) -> dict[str, Any]:
    """The simulated cell as a cell file has it; keys with dots replace single entries."""
    data: dict[str, Any] = {
        "schema": "thinkgrasp/cell-1",
        "name": "simulated lab",
        "robot": {
            "host": "127.0.0.1",
            "home_rad": list(HOME_RAD),
            "gripper": {"port": port},
        },
        "workspace_m": [[0.0, -0.42, -0.005], [0.95, 0.78, 0.9]],
        "grasping_m": [[0.22, -0.40, 0.0], [0.78, 0.40, 0.35]],
        "table": {"x_m": [-0.35, 1.05], "y_m": [-0.6, 0.8]},
        "bin": {"x_m": [0.25, 0.65], "y_m": [0.45, 0.75], "height_m": 0.12},
        "obstacles": [
            {"name": "mount_pole", "center_m": [0.98, 0, 0.375], "size_m": [0.03, 0.03, 0.75]},
            {"name": "mount_beam", "center_m": [0.93, 0, 0.64], "size_m": [0.12, 0.03, 0.03]},
        ],
        "limits": {"joint_speed_rad_s": 2.0, "tcp_speed_m_s": 1.0, "approach_speed_m_s": 0.25},
        "camera": {"mount": "fixed", "file": "camera.json", "settings": {"color_size": [320, 240]}},
    }
    for key, value in changes.items():
        *path, last = key.split(".")
        entry = data
        for part in path:
            entry = entry.setdefault(part, {})
        entry[last] = value
    return data


def make_cell(port: int = 63352, **changes: Any) -> Cell:
    return Cell.model_validate(cell_data(port, **changes))


def write_cell(folder: Path, lab: FakeLab, **changes: Any) -> Path:
    """Write cell.json and camera.json of a lab."""
    camera, T = lab.view.intrinsics, lab.view.T_world_camera
    data: dict[str, Any] = {n: getattr(camera, n) for n in ("width", "height", "fx", "fy", "cx", "cy")}
    error = {"median": 1.2, "max": 2.5}
    record: dict[str, Any] = {"mount": "fixed", "T_world_base": np.eye(4).tolist(), "poses": 15, "held_out_mm": error}
    record["held_out_deg"] = {"median": 0.1, "max": 0.3}
    data |= {"T_world_camera": T.tolist(), "hand_eye": record}
    (folder / "camera.json").write_text(json.dumps(data))
    path = folder / "cell.json"
    path.write_text(json.dumps(cell_data(lab.gripper.port, **changes)))
    return path


class ScriptedPerson:
    """Answers by a script, then yes; keeps what it was asked and told."""

    def __init__(self, answers: Sequence[Answer] = (), *, confirms: Sequence[bool] = ()) -> None:
        self.answers, self.yes_or_no = list(answers), list(confirms)
        self.asked: list[Motion] = []
        self.questions: list[str] = []
        self.told: list[str] = []

    def allows(self, motion: Motion) -> Answer:
        self.asked.append(motion)
        return self.answers.pop(0) if self.answers else "yes"

    def confirms(self, question: str) -> bool:
        self.questions.append(question)
        return self.yes_or_no.pop(0) if self.yes_or_no else False

    def tell(self, line: str) -> None:
        self.told.append(line)


__all__ = ["STROKE_M", "FakeLab", "ScriptedPerson", "cell_data", "make_cell", "write_cell"]
