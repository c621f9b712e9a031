"""How long piles take to settle, and how often a pile comes out with its goal as visible as asked for.

    python benchmarks/settling.py [--piles 5] [--objects 25] [--seeds 6]

A pile of catalogue objects of both splits is dropped and settled inside the workspace; then scenes are made per suite
and visibility. Times are wall times on this machine, without compiling the world.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import get_args

import numpy as np
import tyro

from thinkgrasp.errors import InputError
from thinkgrasp.sim import catalogue, scenes
from thinkgrasp.sim.piles import Pile
from thinkgrasp.sim.world import World

INSTRUCTIONS = ("I need a fruit", "grasp a ball", "get something to hold other things")


@dataclass
class Settling:
    """Settings of the measurement."""

    piles: int = 5
    objects: int = 25
    seeds: int = 6

    def run(self) -> None:
        """Print both tables."""
        print(f"{self.objects} objects: wall time [s], simulated time [s], at rest inside the workspace")
        times = [self.settle(seed) for seed in range(self.piles)]
        for wall, simulated, good in times:
            print(f"  {wall:6.2f} {simulated:6.2f}  {'yes' if good else 'NO'}")
        print(f"  median {np.median([wall for wall, *_ in times]):.2f} s\n")
        print("suite    visibility  piles accepted  wall time per scene: mean, max [s]  failed")
        for suite, make in (("clutter", scenes.clutter), ("heavy", scenes.heavy)):
            for visibility in (None, *get_args(scenes.Visibility)):
                walls, tries, failed = [], 0, 0
                for seed in range(self.seeds):
                    start = time.perf_counter()
                    try:
                        tries += make(INSTRUCTIONS[seed % len(INSTRUCTIONS)], seed, visibility=visibility).tries
                    except InputError:
                        failed += 1
                        tries += scenes.SELECTIONS * scenes.TRIES_PER_SELECTION
                    walls.append(time.perf_counter() - start)
                share = (self.seeds - failed) / tries
                print(
                    f"{suite:8} {visibility or 'any':11} {share:14.0%}  "
                    f"{np.mean(walls):25.2f}, {max(walls):.2f}  {failed:11}"
                )

    def settle(self, seed: int) -> tuple[float, float, bool]:
        """Settle one pile; return wall time, simulated time and whether it came to rest inside the workspace."""
        rng = np.random.default_rng(seed)
        names = rng.permutation(catalogue.names())[: self.objects]
        world = World([catalogue.make(str(name), seed) for name in names], robot=False)
        pile = Pile(world, rng)
        start = time.perf_counter()
        for index in range(self.objects):
            pile.scatter(index)
        good = pile.settle()
        return time.perf_counter() - start, world.time_s, good


if __name__ == "__main__":
    tyro.cli(Settling).run()
