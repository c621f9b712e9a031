"""Hand tools."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLACK, BLUE, BRASS, DARK_GREY, ORANGE, RED, STEEL, TAN, YELLOW
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import arc, box, prism, rod, taper, total, tube, turned


def _screwdriver(handle: RGB, band: RGB, *, flat: bool) -> Build:
    def build(rng: Generator) -> Parts:
        grip = turned([(12, 0), (15, 5), (15, 52), (10, 66), (14, 84)], sides=12).turn("y", 90).at(x=-84)
        tip = box(12, 10, 3).at(x=100, z=-1.5) if flat else taper(4, 1.5, 10, sides=8).turn("y", 90).at(x=94)
        return (
            Part("handle", grip, handle, gloss=0.4),
            Part("collar", rod(11, 8, 12).turn("y", 90), band),
            Part("shaft", rod(4.5, 90, 10).turn("y", 90).at(x=6), STEEL, gloss=0.7),
            Part("tip", tip, DARK_GREY, gloss=0.5),
        )

    return build


def _hammer(handle: RGB, head: RGB, face: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        return (
            Part("handle", tube([(-160, 0, 0), (-60, 0, 0), (0, 0, 0)], [12, 12, 10], sides=12), handle),
            Part("head", box(26, 56, 28, 4).at(x=10, z=-14), head, gloss=0.5),
            Part("face", rod(15, 20).turn("x", 90).at(x=10, y=48), face, gloss=0.5),
            Part("face", rod(15, 20).turn("x", -90).at(x=10, y=-48), face, gloss=0.5),
        )

    return build


def _drill(rng: Generator) -> Parts:
    return (
        Part("battery", box(84, 58, 36, 5), BLACK),
        Part("handle", box(36, 34, 70, 6).at(x=-4, z=36), ORANGE),
        Part("trigger", box(10, 14, 22, 2).at(x=18, z=78), BLACK),
        Part("body", rod(27, 100, 20).turn("y", 90).at(x=-50, z=128), ORANGE),
        Part("chuck", turned([(22, 0), (14, 32)]).turn("y", 90).at(x=50, z=128), BLACK),
        Part("bit", rod(3.5, 32, 8).turn("y", 90).at(x=82, z=128), STEEL, gloss=0.7),
    )


def _wrench(rng: Generator) -> Parts:
    jaws = total(
        [
            prism([(0, 0), (28, 4), (38, 12), (34, 18), (8, 18)], 12).at(x=66, y=-20),
            prism([(0, 18), (8, 0), (34, 0), (38, 6), (28, 14)], 12).at(x=66, y=4),
            box(18, 34, 12).at(x=66),
        ]
    )
    return (
        Part("handle", box(124, 20, 10, 2).at(z=1), STEEL, gloss=0.6),
        Part("jaw", jaws, STEEL, gloss=0.6),
    )


def _pliers(rng: Generator) -> Parts:
    grips = total([tube([(0, 6 * s, 9), (-30, 22 * s, 9), (-105, 24 * s, 9)], 8, sides=10) for s in (-1, 1)])
    jaws = total([prism([(0, 0), (50, 0), (50, 6 * s), (0, 12 * s)], 12).at(x=8, z=3) for s in (-1, 1)])
    return (
        Part("handle", grips, RED),
        Part("jaw", jaws, DARK_GREY, gloss=0.5),
        Part("joint", rod(13, 16).at(x=4, z=1), DARK_GREY, gloss=0.5),
    )


def _small_clamp(rng: Generator) -> Parts:
    handles = total([tube([(0, 6 * s, 11), (-48, 24 * s, 11)], 7, sides=10) for s in (-1, 1)])
    jaws = total([tube([(0, 6 * s, 11), (22, 17 * s, 11), (44, 7 * s, 11)], 6, sides=10) for s in (-1, 1)])
    pads = total([box(14, 6, 16, 2).at(x=46, y=3.5 * s, z=3) for s in (-1, 1)])
    return (
        Part("handle", handles, BLACK),
        Part("jaw", jaws, BLACK),
        Part("pad", pads, ORANGE),
        Part("spring", rod(10, 22, 12).at(x=0), STEEL, gloss=0.6),
    )


def _bar_clamp(rng: Generator) -> Parts:
    return (
        Part("bar", box(200, 16, 8).at(z=8), DARK_GREY, gloss=0.5),
        Part("jaw", box(22, 76, 24, 4).at(x=-88, y=26), ORANGE),
        Part("jaw", box(26, 76, 24, 4).at(x=10, y=26), ORANGE),
        Part("pad", total([box(6, 22, 20).at(x=x, y=52, z=2) for x in (-74, -6)]), BLACK),
        Part("handle", tube([(30, 0, 12), (42, -34, 12), (44, -62, 12)], 11, sides=10), BLACK),
    )


def _padlock(rng: Generator) -> Parts:
    bow = arc(15, 0, 180) + np.array([0, 20, 11])
    shackle = tube([(15, 0, 11), *bow, (-15, 0, 11)], 4.5)
    return (
        Part("body", box(46, 40, 22, 3).at(y=-20), BRASS, gloss=0.6),
        Part("shackle", shackle, STEEL, gloss=0.7),
    )


def _tape_measure(rng: Generator) -> Parts:
    return (
        Part("body", box(68, 36, 66, 10), YELLOW, printing.label(YELLOW, BLACK, BLACK, rng)),
        Part("tongue", box(12, 22, 3).at(x=38, z=3), STEEL),
    )


def _flashlight(rng: Generator) -> Parts:
    return (
        Part("body", rod(15, 96).turn("y", 90), BLACK, gloss=0.3),
        Part("head", turned([(15, 0), (23, 18), (23, 44)], sides=20).turn("y", 90).at(x=96), BLACK, gloss=0.3),
        Part("lens", rod(20, 2, 20).turn("y", 90).at(x=140), (225, 230, 235), gloss=0.9),
        Part("switch", box(16, 8, 3).at(x=60, z=14), RED),
    )


ENTRIES = (
    Entry("flat screwdriver", "tool", ("red", "grey"), 0.1, 0.6, _screwdriver(RED, BLACK, flat=True)),
    Entry("phillips screwdriver", "tool", ("yellow", "grey"), 0.1, 0.6, _screwdriver(YELLOW, BLACK, flat=False)),
    Entry("hammer", "tool", ("brown", "grey"), 0.5, 0.6, _hammer(TAN, DARK_GREY, STEEL)),
    Entry("two color hammer", "tool", ("red", "blue"), 0.35, 0.6, _hammer(RED, BLUE, BLUE)),
    Entry("power drill", "tool", ("orange", "black"), 0.7, 0.6, _drill),
    Entry("wrench", "tool", ("grey",), 0.25, 0.5, _wrench),
    Entry("pliers", "tool", ("red", "grey"), 0.2, 0.6, _pliers),
    Entry("small clamp", "tool", ("black",), 0.06, 0.6, _small_clamp),
    Entry("bar clamp", "tool", ("orange", "black"), 0.35, 0.6, _bar_clamp),
    Entry("padlock", "tool", ("yellow", "grey"), 0.2, 0.5, _padlock),
    Entry("tape measure", "tool", ("yellow", "black"), 0.25, 0.6, _tape_measure),
    Entry("flashlight", "tool", ("black",), 0.15, 0.6, _flashlight),
)
