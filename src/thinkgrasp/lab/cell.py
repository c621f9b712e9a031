"""A cell as a JSON file: what differs from lab to lab, checked when it is read.

World frame: z up, z = 0 on the table top; the rest is the lab's choice and is fixed by `robot.T_world_base`. Every key
and its unit are in docs/real_robot.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import make_transform
from thinkgrasp.motion import ur5e
from thinkgrasp.motion.cell import Bin, StaticBox
from thinkgrasp.motion.height_map import HeightMap
from thinkgrasp.motion.limits import JointLimits
from thinkgrasp.motion.mount import ArmMount
from thinkgrasp.motion.robotiq_2f85 import flange_to_tip

Float = NDArray[np.float64]
Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
"""No text and no true or false for a number: true would be a speed of 1 m/s."""
Triple = tuple[Number, Number, Number]
Span = tuple[Number, Number]

SCHEMA = "thinkgrasp/cell-1"
TABLE_THICKNESS_M = 0.04
JERK_S = 0.05
"""Jerk limit = acceleration limit over this time."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Limits(_Part):
    """What the arm may do at most; every motion is slowed down to it, and refused where it still exceeds it."""

    joint_speed_rad_s: Annotated[Number, Field(gt=0, le=2.1)] = 0.8
    joint_acceleration_rad_s2: Annotated[Number, Field(gt=0, le=8.0)] = 2.0
    tcp_speed_m_s: Annotated[Number, Field(gt=0, le=1.0)] = 0.25
    approach_speed_m_s: Annotated[Number, Field(gt=0, le=0.25)] = 0.05
    """Of the fingertips on the straight ways in and up."""
    force_n: Annotated[Number, Field(ge=10, le=150)] = 50.0
    """At the flange, above what it was before the motion; more stops the motion."""


class GripperPart(_Part):
    """The two-finger gripper, its socket, and how it is mounted."""

    model: Literal["robotiq_2f85", "robotiq_2f140"] = "robotiq_2f85"
    host: str | None = None
    """None = the robot's: the port is opened by the gripper's URCap."""
    port: Annotated[int, Field(ge=1, le=65535)] = 63352
    coupling_m: Annotated[Number, Field(ge=0, le=0.15)] = 0.0
    """Thickness of what is between the arm's flange and the gripper's."""
    yaw_rad: Number = 0.0
    """Turn of the gripper about the flange's z, from fingers that close along the flange's x."""
    open_count: Annotated[int, Field(ge=0, le=127)] = 3
    """What GET POS says when it is fully open."""
    closed_count: Annotated[int, Field(ge=128, le=255)] = 228
    """What GET POS says when the pads meet."""
    force_n: Annotated[Number, Field(ge=10, le=235)] = 40.0
    speed_m_s: Annotated[Number, Field(ge=0.02, le=0.25)] = 0.06
    mass_kg: Annotated[Number, Field(gt=0, le=5)] = 0.925
    """Of gripper and coupling, told to the controller as the payload."""
    center_of_mass_m: Triple = (0.0, 0.0, 0.058)


class RobotPart(_Part):
    """The arm: where it stands and how to reach it."""

    model: Literal["ur5e"] = "ur5e"
    host: Annotated[str, Field(min_length=1)]
    T_world_base: tuple[tuple[Number, Number, Number, Number], ...] = (
        (1, 0, 0, 0),
        (0, 1, 0, 0),
        (0, 0, 1, 0),
        (0, 0, 0, 1),
    )
    """The maker's base frame ("Base" on the pendant) in the world."""
    home_rad: tuple[Number, Number, Number, Number, Number, Number]
    """Where the arm waits while the camera looks."""
    gripper: GripperPart = GripperPart()


class Box(_Part):
    """Something solid that does not move, with sides along the world's axes."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    center_m: Triple
    size_m: tuple[Annotated[Number, Field(gt=0)], Annotated[Number, Field(gt=0)], Annotated[Number, Field(gt=0)]]


class BinPart(_Part):
    """The open box that things go into: inner extent, height of its walls above the table."""

    x_m: Span
    y_m: Span
    height_m: Annotated[Number, Field(ge=0, le=0.6)]
    wall_m: Annotated[Number, Field(gt=0, le=0.05)] = 0.01


class TablePart(_Part):
    """Extent of the table top along x and y."""

    x_m: Span
    y_m: Span


class CameraPart(_Part):
    """The camera: what carries it, its file, and the settings of its plug-in."""

    mount: Literal["fixed", "hand"] = "fixed"
    file: str
    """Camera file with T_world_camera ("fixed") or T_flange_camera ("hand"), as `thinkgrasp calibrate` writes it."""
    settings: dict[str, object] = {}


class Cell(_Part):
    """A whole cell.

    Raises:
        ConfigError: From `load_cell`: a value is missing, of the wrong type or range, or does not fit another.
    """

    schema_: Annotated[Literal["thinkgrasp/cell-1"], Field(alias="schema")]
    name: str = "cell"
    robot: RobotPart
    workspace_m: tuple[Triple, Triple]
    """Lowest and highest corner of the box that fingertips and flange never leave."""
    grasping_m: tuple[Triple, Triple]
    """Of the box in which things may be taken."""
    table: TablePart
    bin: BinPart
    obstacles: tuple[Box, ...] = ()
    limits: Limits = Limits()
    camera: CameraPart | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Cell:
        for name, (low, high) in (("workspace_m", self.workspace_m), ("grasping_m", self.grasping_m)):
            if not all(a < b for a, b in zip(low, high, strict=True)):
                raise ValueError(f"{name} must be two corners, the lowest first, got {low} and {high}")
        spans = {"table": self.table, "bin": self.bin}
        for name, part in spans.items():
            for axis, (low, high) in (("x_m", part.x_m), ("y_m", part.y_m)):
                if not low < high:
                    raise ValueError(f"{name}.{axis} must be two numbers, the lowest first, got {low} and {high}")
        if not _within(self.grasping_m[0], self.workspace_m) or not _within(self.grasping_m[1], self.workspace_m):
            raise ValueError("grasping_m must lie within workspace_m: the fingertips never leave the latter")
        rim = self.bin.height_m + 0.28
        middle = (sum(self.bin.x_m) / 2, sum(self.bin.y_m) / 2, rim)
        if not _within(middle, self.workspace_m):
            raise ValueError(
                f"the place {rim:.2f} m over the middle of the bin, {middle}, must lie within workspace_m: things are "
                "let go there"
            )
        names = [box.name for box in self.statics]
        if len(set(names)) != len(names):
            raise ValueError(f"obstacles must have names of their own; table and bin walls have theirs: {names}")
        if self.robot.gripper.model != "robotiq_2f85":
            raise ValueError(
                "motions can be planned for the robotiq_2f85 only: the planner's model of the arm carries that gripper"
            )
        home = np.array(self.robot.home_rad)
        if not ur5e.LIMITS.contain(home):
            low, high = (np.round(a, 2).tolist() for a in (ur5e.LIMITS.lower, ur5e.LIMITS.upper))
            raise ValueError(f"robot.home_rad is outside of the joints' ranges: {low} to {high}")
        for what, T in (("fingertips are", self.fingertips(home)), ("flange is", self.flange(home))):
            if not _within(T[:3, 3], self.workspace_m):
                at = np.round(T[:3, 3], 3).tolist()
                raise ValueError(f"at robot.home_rad the {what} at {at}, outside of workspace_m")
        return self

    @cached_property
    def mount(self) -> ArmMount:
        """Where the arm stands and how the gripper sits on it."""
        gripper = self.robot.gripper
        c, s = np.cos(gripper.yaw_rad), np.sin(gripper.yaw_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        T_flange_gripper = make_transform(turn, np.array([0.0, 0.0, gripper.coupling_m]))
        return ArmMount(np.array(self.robot.T_world_base, np.float64), T_flange_gripper)

    @property
    def home(self) -> Float:
        """(6,) [rad]."""
        return np.array(self.robot.home_rad, np.float64)

    @property
    def T_flange_tcp(self) -> Float:  # noqa: N802
        """(4, 4) fingertips, pads together, on the arm's flange: what the controller's TCP has to say."""
        return self.mount.T_flange_gripper @ flange_to_tip(0.0)

    def fingertips(self, q: Float, opening_m: float = 0.0) -> Float:
        """Return T_world_tcp (..., 4, 4) at joint angles q (..., 6) [rad]."""
        return self.mount.in_world(ur5e.forward(q)) @ flange_to_tip(opening_m)

    def flange(self, q: Float) -> Float:
        """Return T_world_flange (..., 4, 4) at joint angles q (..., 6) [rad]."""
        return self.mount.T_world_base @ ur5e.forward(q)

    @property
    def bin_box(self) -> Bin:
        """The bin."""
        return Bin(self.bin.x_m, self.bin.y_m, self.bin.height_m, self.bin.wall_m)

    @property
    def statics(self) -> tuple[StaticBox, ...]:
        """Table, walls of the bin and obstacles."""
        (x0, x1), (y0, y1), half = self.table.x_m, self.table.y_m, TABLE_THICKNESS_M / 2
        table = StaticBox("table", ((x0 + x1) / 2, (y0 + y1) / 2, -half), ((x1 - x0) / 2, (y1 - y0) / 2, half))
        walls = self.bin_box.walls if self.bin.height_m > 0 else ()
        boxes = [StaticBox(b.name, b.center_m, tuple(s / 2 for s in b.size_m)) for b in self.obstacles]  # type: ignore[arg-type]
        return (table, *walls, *boxes)

    @property
    def height_map(self) -> HeightMap:
        """Where the perceived cloud is looked at: under the workspace."""
        (x0, y0, _), (x1, y1, z1) = self.workspace_m
        return HeightMap((x0, x1), (y0, y1), highest_m=float(np.clip(z1, 0.1, 1.0)))

    @property
    def joint_limits(self) -> JointLimits:
        """Ranges of the arm with the rates of this cell."""
        acceleration = np.full(6, self.limits.joint_acceleration_rad_s2)
        return JointLimits(
            ur5e.LIMITS.lower,
            ur5e.LIMITS.upper,
            np.full(6, self.limits.joint_speed_rad_s),
            acceleration,
            acceleration / JERK_S,
        )

    def slowed(self, share: float) -> Cell:
        """Return the cell with its speeds cut to a share.

        Raises:
            ConfigError: The share is not in (0, 1]: limits are raised in the cell file only.
        """
        if not 0 < share <= 1:
            raise ConfigError(
                f"speed is a share of the cell's limits and must lie in (0, 1], got {share}; limits are raised in the "
                "cell file only"
            )
        limits, gripper = self.limits, self.robot.gripper
        slow = limits.model_copy(
            update={
                "joint_speed_rad_s": limits.joint_speed_rad_s * share,
                "tcp_speed_m_s": limits.tcp_speed_m_s * share,
                "approach_speed_m_s": limits.approach_speed_m_s * share,
            }
        )
        fingers = gripper.model_copy(update={"speed_m_s": gripper.speed_m_s * share})  # the gripper has a least speed
        robot = self.robot.model_copy(update={"gripper": fingers})
        return self.model_copy(update={"limits": slow, "robot": robot})


def load_cell(path: str | Path) -> Cell:
    """Read a cell file.

    Raises:
        ConfigError: It cannot be read, or a value cannot be used; the message names the key.
    """
    path = Path(path)
    try:
        data: object = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"cell file {path} is not readable JSON: {error}") from error
    if not isinstance(data, Mapping) or data.get("schema") != SCHEMA:
        raise ConfigError(f'cell file {path} must be a JSON object with "schema": "{SCHEMA}"')
    try:
        cell = Cell.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"cell file {path}: {_first(error)}") from error
    except ConfigError as error:
        raise ConfigError(f"cell file {path}: {error}") from error
    return cell


def _within(point: Triple | Float, box: tuple[Triple, Triple]) -> bool:
    return all(low <= p <= high for low, p, high in zip(box[0], point, box[1], strict=True))


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    message = first["msg"].removeprefix("Value error, ")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return (f"{where}: {message}" if where else message) + more
