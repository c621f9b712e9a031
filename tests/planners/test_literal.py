"""The planner that is none."""

from __future__ import annotations

import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.memory import Memory
from thinkgrasp.planners.literal import LiteralPlanner
from thinkgrasp.testing import sample_scene


@pytest.mark.parametrize(("grid", "cell"), [(1, 1), (2, 1), (3, 5), (4, 6)])
def test_the_instruction_is_the_target_and_the_middle_the_cell(grid, cell):
    plan = LiteralPlanner(grid=grid).plan(sample_scene(), "something to drink from", Memory())
    assert (plan.target, plan.role, plan.mark, plan.grid, plan.cell) == (
        "something to drink from",
        "goal",
        None,
        grid,
        cell,
    )


def test_a_grid_has_cells():
    with pytest.raises(ConfigError, match=r"within 1\.\.15, got 0"):
        LiteralPlanner(grid=0)
