"""Machine parts."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from thinkgrasp.sim.catalogue.entry import Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLUE, DARK_GREY, GREEN, GREY, ORANGE, STEEL
from thinkgrasp.sim.catalogue.solid import box, prism, rod, total, turned, vessel


def _gearbox(rng: Generator) -> Parts:
    feet = total([box(16, 74, 8).at(x=x) for x in (-28, 28)])
    return (
        Part("body", box(72, 54, 56, 5).at(z=6), BLUE, gloss=0.3),
        Part("foot", feet, BLUE),
        Part("shaft", rod(7, 26, 12).turn("y", 90).at(x=36, z=36), STEEL, gloss=0.7),
        Part("flange", rod(20, 8, 16).turn("y", -90).at(x=-36, z=34), STEEL, gloss=0.7),
    )


def _mount(rng: Generator) -> Parts:
    ribs = total([prism([(0, 0), (30, 0), (0, 34)], 6).turn("x", 90).at(x=8, y=y, z=10) for y in (-19, 25)])
    return (
        Part("base", box(84, 54, 10, 1), GREY, gloss=0.4),
        Part("wall", box(12, 54, 56, 1).at(x=2, z=9), GREY, gloss=0.4),
        Part("rib", ribs, GREY, gloss=0.4),
        Part("bolt", total([rod(6, 6, 6).at(x=x, y=y, z=10) for x in (-26,) for y in (-16, 16)]), DARK_GREY),
    )


def _turbine_housing(rng: Generator) -> Parts:
    volute = turned([(30, 0), (36, 8), (36, 30), (28, 40)])
    outlet = rod(15, 40).turn("x", 90).at(x=20, z=19)
    return (
        Part("body", volute, GREY, gloss=0.4),
        Part("outlet", outlet + rod(19, 7).turn("x", 90).at(x=20, y=-40, z=19), GREY, gloss=0.4),
        Part("rim", vessel([(22, 40), (22, 56)], 6, None), DARK_GREY, gloss=0.4),
    )


def _pipe_connector(rng: Generator) -> Parts:
    ends = total([rod(20, 12, 20).turn("y", a).at(x=x, z=20) for a, x in ((90, 34), (-90, -34))])
    return (
        Part("body", rod(16, 72, 20).turn("y", 90).at(x=-36, z=20), GREEN),
        Part("branch", rod(15, 38, 20).at(z=20), GREEN),
        Part("rim", ends + rod(19, 12, 20).at(z=52), GREEN),
    )


def _gear(rng: Generator) -> Parts:
    tooth = prism([(27, -5.5), (38, -3), (38, 3), (27, 5.5)], 16)
    return (
        Part("body", rod(30, 16, 30), ORANGE, gloss=0.3),
        Part("teeth", total([tooth.turn("z", float(a)) for a in np.arange(0, 360, 30)]), ORANGE, gloss=0.3),
        Part("hub", rod(11, 30, 16), DARK_GREY),
    )


ENTRIES = (
    Entry("gearbox", "machine part", ("blue", "grey"), 0.4, 0.55, _gearbox),
    Entry("machine part", "machine part", ("grey",), 0.3, 0.55, _mount),
    Entry("turbine housing", "machine part", ("grey",), 0.35, 0.55, _turbine_housing),
    Entry("gear", "machine part", ("orange",), 0.1, 0.6, _gear),
    Entry("pipe connector", "tool", ("green",), 0.12, 0.6, _pipe_connector),
)
