"""A block on a table in front of a real arm's driver, the vendor's interface behind it being simulated."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from fakes.cell import look, top_down
from fakes.lab import FakeLab, ScriptedPerson, make_cell
from fakes.things import box

from thinkgrasp.motion.cell import HOME_RAD
from thinkgrasp.robots.ur_rtde import URRobot
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.views import default_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Grasp

BLOCK = box((0.04, 0.06, 0.05), (0.8, 0.1, 0.1))
MOTIONS = (
    *("open the gripper to 54 mm", "to the pre-grasp", "straight in", "close the gripper", "straight up"),
    *("to the bin", "open the gripper over the bin", "home"),
)


@cache
def _frame_of_the_block() -> Frame:
    return look(_world(), default_view("l515", (320, 240)))


def _world() -> World:
    """A block on the table, and a heavy one that is not there yet."""
    world = World([BLOCK, replace(BLOCK, mass_kg=8.0)])
    world.place(0, pose(0.5, 0.0, 0.025))
    world.settle()
    return world


class Scene:
    """A block on the table of a fake lab, a frame of it, and a grasp that works."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.world = _world()
        self.lab = FakeLab(self.world, noise=None)
        for name, module in self.lab.modules().items():
            monkeypatch.setitem(sys.modules, name, module)
        self.frame = _frame_of_the_block()
        self.robots: list[URRobot] = []
        self.time_s = 0.0

    def grasp(self, x: float = 0.5, y: float = 0.0, z: float = 0.02, width: float = 0.054) -> Grasp:
        return top_down(x, y, z, width=width, view=self.lab.view)

    def robot(self, person: ScriptedPerson | None = None, cell: dict[str, Any] | None = None, **settings) -> URRobot:
        made = make_cell(self.lab.gripper.port, **(cell or {}))
        settings = {"sleep": self.lab.sleep, "clock": self.lab.clock, **settings}
        self.robots.append(URRobot(cell=made, person=person or ScriptedPerson(), **settings))
        return self.robots[-1]

    def untouched(self) -> bool:
        """Whether neither arm nor fingers were ever told to move."""
        told = [r for r in self.lab.gripper.requests if r.startswith("SET")]
        return self.lab.moved == 0 and not told

    def is_home(self) -> bool:
        return bool(np.abs(self.world.joints() - HOME_RAD).max() < 0.02 and self.world.opening() > 0.08)


def events(robot: URRobot, name: str) -> list[dict[str, object]]:
    return [line for line in robot.journal.lines if line["event"] == name]


def after(lab: FakeLab, periods: int, fault: Callable[[], None]) -> None:
    lab.after = lambda done: fault() if done == periods else None
