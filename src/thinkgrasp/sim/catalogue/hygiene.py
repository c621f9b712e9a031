"""What lies in a bathroom, and what cleans."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Entry, Part, Parts
from thinkgrasp.sim.catalogue.food import carton
from thinkgrasp.sim.catalogue.palette import BLUE, GREEN, LEAF, NAVY, PINK, RED, SKY, WHITE, YELLOW
from thinkgrasp.sim.catalogue.solid import Solid, box, egg, loft, rod, tube


def _soap(rng: Generator) -> Parts:
    bar = loft([(0, 38, 24), (6, 43, 28), (20, 43, 28), (26, 38, 24)], power=3.5)
    return (Part("body", bar, (244, 170, 196), gloss=0.4),)


def _toothpaste_tube(rng: Generator) -> Parts:
    steps = [(0, 17, 17), (36, 19, 15), (58, 20.5, 12), (108, 24, 4), (116, 24, 3)]

    def lying(solid: Solid) -> Solid:
        return solid.turn("y", -90).turn("x", 90).turn("y", -7)

    return (
        Part("body", lying(loft(steps[:2]) + loft(steps[2:])), WHITE, gloss=0.5),
        Part("stripe", lying(loft(steps[1:3])), RED, gloss=0.5),
        Part("cap", lying(rod(14, 20).at(z=-20)), BLUE, gloss=0.4),
    )


def _thera_med(rng: Generator) -> Parts:
    print_ = printing.label(WHITE, BLUE, RED, rng, repeats=2, height=144)
    body = loft([(0, 20, 18), (4, 22, 20), (92, 22, 20), (112, 16, 16)])
    return (
        Part("body", body, WHITE, print_, "cylinder", 0.5),
        Part("cap", loft([(112, 17, 17), (146, 15, 15)]), BLUE, gloss=0.4),
    )


def _toothbrush(rng: Generator) -> Parts:
    handle = tube([(-90, 0, 6), (-20, 0, 6), (30, 0, 6), (78, 0, 6)], [6, 5.5, 4, 5], sides=8)
    return (
        Part("handle", handle, GREEN, gloss=0.4),
        Part("bristles", box(26, 10, 11).at(x=66, z=9), WHITE),
    )


def _sponge(rng: Generator) -> Parts:
    pores = printing.speckles(YELLOW, (214, 172, 30), 160, rng, 1.6)
    return (
        Part("body", box(108, 68, 24, 1.5).at(z=8), YELLOW, pores, "box", 0.0),
        Part("pad", box(108, 68, 8), LEAF, gloss=0.0),
    )


def _medicine(rng: Generator) -> Parts:
    amber = (226, 120, 40)
    return (
        Part("body", rod(23, 60, 20), amber, printing.label(amber, WHITE, WHITE, rng, repeats=2), "cylinder", 0.6),
        Part("cap", rod(24.5, 20, 20).at(z=60), WHITE),
    )


def _deodorant(rng: Generator) -> Parts:
    print_ = printing.label(NAVY, SKY, WHITE, rng, repeats=2)
    return (
        Part("body", loft([(0, 28, 18), (82, 28, 18)], power=3), BLUE, print_, "cylinder", 0.4),
        Part("cap", loft([(82, 28.5, 18.5), (104, 27, 17), (116, 18, 11)], power=3), WHITE),
    )


def _hair_brush(rng: Generator) -> Parts:
    return (
        Part("handle", tube([(-95, 0, 13), (-40, 0, 13), (0, 0, 12)], [10, 9, 7], sides=10), PINK),
        Part("head", egg(50, 28, 9).at(x=42, z=13), PINK),
        Part("bristles", box(66, 36, 22, 4).at(x=42, z=12), NAVY),
    )


ENTRIES = (
    Entry("soap", "hygiene", ("pink",), 0.11, 0.5, _soap),
    Entry("toothpaste tube", "hygiene", ("white", "red", "blue"), 0.12, 0.6, _toothpaste_tube),
    Entry("toothpaste box", "hygiene", ("red", "white"), 0.13, 0.6, carton(180, 40, 36, RED, WHITE, WHITE)),
    Entry("thera med", "hygiene", ("white", "blue"), 0.15, 0.6, _thera_med),
    Entry("toothbrush", "hygiene", ("green", "white"), 0.02, 0.6, _toothbrush),
    Entry("medicine bottle", "medicine", ("white", "orange"), 0.06, 0.6, _medicine),
    Entry("deodorant", "hygiene", ("blue", "white"), 0.11, 0.6, _deodorant),
    Entry("hair brush", "hygiene", ("pink", "blue"), 0.09, 0.6, _hair_brush),
    Entry("sponge", "cleaning", ("yellow", "green"), 0.02, 0.85, _sponge),
)
