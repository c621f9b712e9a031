"""A table with two blocks, a camera above it and a robot that takes them: enough to close the loop without physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from fakes.stages import TABLE_M, table_frame

from thinkgrasp.types import Frame, Grasp, Outcome

POSE = np.diag([1.0, -1.0, -1.0, 1.0])
"""A camera that looks straight down, in the world."""


class FakeTable:
    """Blocks that are there until taken."""

    def __init__(self) -> None:
        self.there = {"red", "blue"}

    def frame(self, T_world_camera: np.ndarray = POSE) -> Frame:
        full = table_frame(T_world_camera=T_world_camera)
        color, depth = full.color.copy(), full.depth.copy()
        for name, columns in (("red", slice(0, 32)), ("blue", slice(32, 64))):
            if name not in self.there:
                color[:, columns], depth[:, columns] = 180, TABLE_M
        return replace(full, color=color, depth=depth)


class FakeCamera:
    """Looks at the table; counts how often."""

    def __init__(self, table: FakeTable, T_world_camera: np.ndarray = POSE) -> None:
        self.table, self.pose, self.reads = table, T_world_camera, 0

    def read(self) -> Frame:
        self.reads += 1
        return self.table.frame(self.pose.copy())


class FakeRobot:
    """Takes what it is told to, or does with it what the script says: "held", "missed", or "lies" (says held)."""

    def __init__(self, table: FakeTable, script: Sequence[str] = ()) -> None:
        self.table, self.script, self.grasps = table, list(script), list[Grasp]()

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        self.grasps.append(grasp)
        what = self.script.pop(0) if self.script else "held"
        if what == "held":
            self.table.there.discard("red" if grasp.position[0] < 0 else "blue")
        return Outcome(what in ("held", "lies"), "held" if what == "lies" else what)


class FakeRecorder:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, str | None]] = []

    def record(self, decision, outcome) -> None:
        self.steps.append((decision.status, None if outcome is None else outcome.reason))
