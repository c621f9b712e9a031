"""Write a planner, check that it keeps the contract, and run it in place of the built-in one.

A planner is any object with `plan(scene, instruction, memory) -> Plan`. This one always takes the tallest thing. To use
it by name (`--planner tallest`), a package registers it by entry point: see docs/plugins.md.

    python examples/03_your_own_planner.py
"""

from __future__ import annotations

from thinkgrasp import Memory, Plan, Scene, make_pipeline
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render
from thinkgrasp.testing import check_planner


class TallestFirst:
    """Takes the tallest thing in view, at the middle of its top row of cells."""

    def __init__(self, grid: int = 3) -> None:
        self.grid = grid

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Choose the tallest proposal that was not tried in vain before."""
        untried = [p for p in scene.proposals if not memory.failures_at(p)]
        if not untried:
            return Plan("", "nothing is in view that was not tried", grid=self.grid, cell=1, found=False)
        p = max(untried, key=lambda p: p.height_m[1])
        rationale = f"it is the tallest thing in view, {100 * p.height_m[1]:.0f} cm"
        return Plan(f"thing {p.mark}", rationale, mark=p.mark, grid=self.grid, cell=self.grid // 2 + 1)


def main() -> None:
    """Check the planner, then decide with it."""
    planner = TallestFirst()
    check_planner(planner)
    print("the planner keeps its contract")

    pipeline = make_pipeline("offline")
    pipeline.planner = planner
    frame = render(demo_scene(seed=0), *demo_camera()).frame
    decision = pipeline.decide(frame, "clear the table")
    print(f"{decision.status}: {decision.plan.target}, because {decision.plan.rationale}")


if __name__ == "__main__":
    main()
