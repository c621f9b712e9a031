"""What the time of an attempt goes to, in piles of 15 objects seen at 224x224; and how fast 25 objects settle.

    python benchmarks/attempts.py [--attempts 10] [--piles 5]

An attempt is all of a step of the loop but its decisions: planning the motions, carrying them out, and the next frame.
Attempts are those of episodes of the preset `oracle` with a hidden goal, one after another until there are enough. All
runs in one process with one thread for linear algebra. Times are wall times on this machine.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any
from unittest.mock import patch

import numpy as np
import tyro
from settling import Settling
from trials import run_all

from thinkgrasp.benchmark.failures import counted
from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.motion.arm import ArmMotion
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.sim import scenes
from thinkgrasp.sim.oracle import ORACLE
from thinkgrasp.sim.world import World
from thinkgrasp.testbed import CameraOptions, Session
from thinkgrasp.types import Decision, Outcome

INSTRUCTION = "I need a fruit"
SIZE = (224, 224)
PARTS: dict[str, tuple[type, tuple[str, ...]]] = {
    "physics": (World, ("step",)),
    "rendering": (SimulatedCamera, ("read",)),
    "motion planning": (ArmMotion, ("plan_grasp", "plan_to", "plan_to_poses")),
    "decision": (Pipeline, ("decide",)),
}
"""Methods whose time is taken; what is left of an attempt is "other"."""
ATTEMPT_S, SHARE, SETTLING_S = 1.5, 0.60, 2.0
"""What is aimed for: an attempt, the share of physics and rendering in it, settling."""


@dataclass(frozen=True)
class Settings:
    """What is measured."""

    attempts: int
    objects: int


@dataclass(frozen=True)
class Timed:
    """One attempt."""

    reason: str
    seconds: float
    parts: dict[str, float]
    """Adds up to `seconds`."""


class Stopwatch:
    """Adds up the time spent in some methods; a method called by another of them counts for the caller."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running = False

    @contextmanager
    def watching(self, parts: dict[str, tuple[type, tuple[str, ...]]]) -> Iterator[None]:
        """Take the time of methods, given by part as class and names."""
        with ExitStack() as stack:
            for part, (owner, names) in parts.items():
                for name in names:
                    stack.enter_context(patch.object(owner, name, self._timed(part, getattr(owner, name))))
            yield

    def _timed(self, part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._running:
                return method(*args, **kwargs)
            self._running, start = True, time.perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._running = False

        return timed


class _Laps:
    """Notes at the end of every step what the stopwatch added up since its start."""

    def __init__(self, watch: Stopwatch) -> None:
        self._watch = watch
        self.parts: list[dict[str, float]] = []

    def start(self) -> bool:
        """To be asked before every step; the episode goes on."""
        self._watch.seconds.clear()
        return False

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Note a step."""
        self.parts.append({part: self._watch.seconds[part] for part in PARTS})


def measure(settings: Settings) -> list[Timed]:
    """Run episodes until there are enough attempts."""
    found: list[Timed] = []
    watch, seed = Stopwatch(), 0
    with watch.watching(PARTS):
        while len(found) < settings.attempts:
            scene = scenes.clutter(INSTRUCTION, seed, n_objects=settings.objects, visibility="hidden")
            session = Session(scene, CameraOptions(size_wh=SIZE), seed=seed)
            laps = _Laps(watch)
            limit = settings.attempts - len(found)
            run = session.run(session.pipeline(ORACLE), step_limit=limit, recorders=[laps], stop=laps.start)
            for step, parts in zip(run.episode.steps, laps.parts, strict=True):
                if step.outcome is not None:
                    whole = step.duration_s - parts.pop("decision")
                    other = whole - sum(parts.values())
                    found.append(Timed(step.outcome.reason, whole, {**parts, "other": other}))
            seed += 1
    return found


def report(attempts: Sequence[Timed], objects: int) -> str:
    """Return the table of parts in Markdown."""
    whole = np.array([a.seconds for a in attempts])
    held = [a.seconds for a in attempts if a.reason == "held"]
    parts = {part: np.array([a.parts[part] for a in attempts]) for part in attempts[0].parts}
    lines = [
        f"{len(attempts)} attempts ({counted(a.reason for a in attempts)}), "
        f"{objects} objects at the start, {SIZE[0]}x{SIZE[1]}:",
        "",
        "| part | median s | 90th percentile s | share of all |",
        "| --- | --- | --- | --- |",
    ]
    for part, seconds in (*parts.items(), ("all", whole)):
        p50, p90 = np.percentile(seconds, (50, 90))
        lines.append(f"| {part} | {p50:.2f} | {p90:.2f} | {100 * seconds.sum() / whole.sum():.0f} % |")
    simulated = (parts["physics"].sum() + parts["rendering"].sum()) / whole.sum()
    median = f"median {np.median(whole):.2f} s" + (f", of those that held {np.median(held):.2f} s" if held else "")
    return "\n".join(
        [
            *lines,
            "",
            f"- an attempt without its decision: {median}; target at most {ATTEMPT_S} s",
            f"- physics and rendering: {100 * simulated:.0f} %; target at least {100 * SHARE:.0f} %",
        ]
    )


def main(attempts: int = 10, objects: int = 15, piles: int = 5, pile_objects: int = 25) -> None:
    """Measure and print.

    Args:
        attempts: How many.
        objects: In the pile that is worked on.
        piles: That are settled; 0 = none.
        pile_objects: In each of them.
    """
    (measured,) = run_all(measure, [Settings(attempts, objects)], workers=1)
    print(report(measured, objects))
    if piles:
        settled = run_all(Settling(objects=pile_objects).settle, range(piles), workers=1)
        walls = [wall for wall, *_ in settled]
        print(
            f"- settling {pile_objects} objects: median of {piles} piles {np.median(walls):.2f} s, "
            f"most {max(walls):.2f} s; target at most {SETTLING_S} s"
        )


if __name__ == "__main__":
    tyro.cli(main)
