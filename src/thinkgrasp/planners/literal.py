"""No planner at all: the instruction itself is what the segmenter looks for. The paper's ablation without a model."""

from __future__ import annotations

from thinkgrasp.errors import ConfigError
from thinkgrasp.memory import Memory
from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Plan, Scene


class LiteralPlanner:
    """Pass the instruction on as the target, to be taken in the middle; what failed is not remembered.

    Args:
        grid: Cells per side of the target's box; the middle one is planned.

    Raises:
        ConfigError: The grid is out of range.
    """

    def __init__(self, *, grid: int = 3) -> None:
        if not 1 <= grid <= 15:
            raise ConfigError(f"literal planner: grid must be within 1..15, got {grid}")
        self.grid = grid

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Return the instruction as a plan."""
        rationale = "no planner: the instruction itself is looked for"
        return Plan(instruction, rationale, grid=self.grid, cell=middle_cell(self.grid))
