"""Balls."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLUE, RED, SKY, WHITE
from thinkgrasp.sim.catalogue.printing import Picture
from thinkgrasp.sim.catalogue.solid import ball

FELT = (226, 220, 50)


def _ball(radius: float, color: printing.RGB, picture: Picture | None = None, gloss: float = 0.2) -> Build:
    def build(rng: Generator) -> Parts:
        return (Part("body", ball(radius), color, picture, "sphere", gloss),)

    return build


ENTRIES = (
    Entry("tennis ball", "ball", ("yellow",), 0.058, 0.85, _ball(33, FELT, printing.seam(FELT, WHITE), 0.0)),
    Entry("racquetball", "ball", ("blue",), 0.04, 0.8, _ball(28, BLUE, printing.seam(BLUE, SKY, 2), 0.3)),
    Entry("softball", "ball", ("yellow",), 0.19, 0.75, _ball(39, FELT, printing.seam(FELT, RED, 3), 0.1)),
    Entry("baseball", "ball", ("white",), 0.145, 0.7, _ball(36, WHITE, printing.seam(WHITE, RED, 3), 0.1)),
    Entry(
        "golf ball",
        "ball",
        ("white",),
        0.046,
        0.6,
        _ball(21, WHITE, printing.panels(WHITE, (222, 222, 220), 8, 14), 0.5),
    ),
    Entry("white ball", "ball", ("white",), 0.07, 0.65, _ball(32, WHITE, gloss=0.5)),
    Entry("blue ball", "ball", ("blue",), 0.07, 0.65, _ball(32, BLUE, gloss=0.5)),
    Entry("red ball", "ball", ("red",), 0.05, 0.7, _ball(27, RED, gloss=0.5)),
)
