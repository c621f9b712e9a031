"""How often a single object is lifted and held up to the bin, over the whole catalogue.

    python benchmarks/grasping.py [--per-object 2] [--objects pear mug] [--workers 2]

One object at a time lies at a random place of the workspace, turned at random about the vertical, at rest. Its mask is
the simulator's; grasps are proposed, checked and chosen on the measured depth as in the closed loop, and the best one
is executed. It counts when both fingers held the object after the lift and over the bin, by contact.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import tyro
from scipy.spatial.transform import Rotation
from trials import rate, run_all

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.config import load_config
from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import make_transform
from thinkgrasp.motion.cell import WORKSPACE_M
from thinkgrasp.robots.simulated import SimulatedRobot
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.oracle import oracle_pipeline
from thinkgrasp.sim.world import World
from thinkgrasp.testbed import for_the_loop
from thinkgrasp.types import Frame

TARGET = 0.93
"""Share of executed grasps that shall hold."""
INSIDE_M = 0.10
"""Objects lie at least this far inside the workspace's edge."""
DROP_M = 0.005
"""They fall from this height and come to rest as they like."""
NO_GRASP = "no grasp"


@dataclass(frozen=True)
class Job:
    """One object in one place."""

    name: str
    seed: int


@dataclass(frozen=True)
class Result:
    """What became of it."""

    name: str
    category: str
    seed: int
    reason: str
    """The robot's outcome, or NO_GRASP."""
    detail: str
    """Score and opening of the grasp, or where the proposals were lost."""

    @property
    def executed(self) -> bool:
        """Whether there was a grasp to execute."""
        return self.reason != NO_GRASP

    @property
    def held(self) -> bool:
        """Whether it was held up to the bin."""
        return self.reason == "held"


def try_object(job: Job) -> Result:
    """Grasp one object once."""
    world, frame = lone_object(job)
    obj = world.objects[0]
    decision = oracle_pipeline(for_the_loop(load_config("offline")), world, [0]).decide(frame, f"the {job.name}")
    if decision.grasp is None:
        funnel = ", ".join(f"{step.check} {step.n_out}" for step in decision.funnel)
        return Result(job.name, obj.category, job.seed, NO_GRASP, funnel or decision.status)
    outcome = SimulatedRobot(world).execute(decision.grasp, frame)
    detail = f"score {decision.grasp.score:.2f}, opening {1e3 * decision.grasp.width_m:.0f} mm"
    return Result(job.name, obj.category, job.seed, outcome.reason, detail)


def lone_object(job: Job) -> tuple[World, Frame]:
    """Return the cell with one object at rest, and what the camera sees of it."""
    obj = catalogue.make(job.name, job.seed)
    world = World([obj])
    rng = np.random.default_rng([job.seed, *job.name.encode()])
    xy = [rng.uniform(low + INSIDE_M, high - INSIDE_M) for low, high in WORKSPACE_M]
    turned = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    world.place(0, make_transform(turned, np.array([*xy, DROP_M - obj.bounds_m[0, 2]])))
    world.settle()
    return world, SimulatedCamera(world, seed=job.seed).read()


def report(results: Sequence[Result]) -> str:
    """Return totals, the table per object and the worst ten in Markdown."""
    executed = [r for r in results if r.executed]
    held = sum(r.held for r in results)
    reasons = Counter(r.reason for r in results)
    rows = [_Row(name, [r for r in results if r.name == name]) for name in dict.fromkeys(r.name for r in results)]
    lines = [
        f"- of executed grasps: {rate(held, len(executed))}; target {100 * TARGET:.0f} %",
        f"- of all scenes, no grasp counted as a failure: {rate(held, len(results))}",
        f"- outcomes: {', '.join(f'{reason} {n}' for reason, n in reasons.most_common())}",
        "",
        "| object | category | held/executed | no grasp | failures |",
        "| --- | --- | --- | --- | --- |",
        *(f"| {r.name} | {r.results[0].category} | {r.held}/{r.executed} | {r.no_grasp} | {r.reasons} |" for r in rows),
    ]
    worst = sorted((r for r in rows if r.held < len(r.results)), key=lambda r: (r.held / len(r.results), r.executed))
    if worst:
        lines += ["", "The worst ten:", ""]
    for row in worst[:10]:
        failed = "; ".join(f"seed {r.seed} {r.reason} ({r.detail})" for r in row.results if not r.held)
        lines.append(f"- {row.name}, {row.held} of {len(row.results)}: {failed}")
    return "\n".join(lines)


@dataclass(frozen=True)
class _Row:
    name: str
    results: list[Result]

    @property
    def held(self) -> int:
        return sum(r.held for r in self.results)

    @property
    def executed(self) -> int:
        return sum(r.executed for r in self.results)

    @property
    def no_grasp(self) -> int:
        return len(self.results) - self.executed

    @property
    def reasons(self) -> str:
        failed = Counter(r.reason for r in self.results if r.executed and not r.held)
        return ", ".join(f"{reason} {n}" for reason, n in failed.most_common())


def main(per_object: int = 2, objects: tuple[str, ...] = (), first_seed: int = 0, workers: int = 2) -> None:
    """Grasp every object and print the report.

    Args:
        per_object: Scenes of each object.
        objects: Names from the catalogue; none = all.
        first_seed: Of an object's first scene.
        workers: Processes.
    """
    if unknown := set(objects) - set(catalogue.names()):
        raise ConfigError(f"not in the catalogue: {', '.join(sorted(unknown))}")
    jobs = [
        Job(name, seed)
        for name in objects or catalogue.names()
        for seed in range(first_seed, first_seed + per_object)
    ]  # fmt: skip
    results: list[Result] = []
    for result in run_all(try_object, jobs, workers):
        results.append(result)
        if not result.held:
            print(f"{result.name} seed {result.seed}: {result.reason}, {result.detail}", file=sys.stderr, flush=True)
    places = {(job.name, job.seed): place for place, job in enumerate(jobs)}
    print(report(sorted(results, key=lambda r: places[r.name, r.seed])))


if __name__ == "__main__":
    tyro.cli(main)
