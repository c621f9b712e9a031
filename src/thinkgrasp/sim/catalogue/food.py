"""Packaged food: boxes, cans, cartons."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import (
    BLUE,
    BROWN,
    CREAM,
    DARK_BROWN,
    GREEN,
    LIME,
    NAVY,
    ORANGE,
    PINK,
    RED,
    SKY,
    STEEL,
    WHITE,
    YELLOW,
)
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import box, egg, prism, ring, rod, tube, turned


def carton(x: float, y: float, z: float, base: RGB, accent: RGB, ink: RGB) -> Build:
    """A printed cardboard box."""

    def build(rng: Generator) -> Parts:
        return (Part("body", box(x, y, z), base, printing.label(base, accent, ink, rng), "box", 0.15),)

    return build


def can(radius: float, height: float, base: RGB, accent: RGB, ink: RGB) -> Build:
    """A tin can with a paper label between its rims."""

    def build(rng: Generator) -> Parts:
        rim = min(6.0, 0.1 * height)
        print_ = printing.label(base, accent, ink, rng, repeats=2)
        return (
            Part("body", rod(radius, height - 2 * rim, 24).at(z=rim), base, print_, "cylinder", 0.25),
            Part("bottom", rod(radius, rim, 24), STEEL, gloss=0.7),
            Part("rim", rod(radius, rim, 24).at(z=height - rim), STEEL, gloss=0.7),
        )

    return build


def _soda_can(rng: Generator) -> Parts:
    body = turned([(26, 0), (32, 8), (32, 104), (27, 116)])
    return (
        Part("body", body, RED, printing.label(RED, WHITE, WHITE, rng, repeats=2), "cylinder", 0.6),
        Part("rim", rod(27, 3, 24).at(z=116), STEEL, gloss=0.7),
        Part("tab", egg(7, 11, 0.8).at(y=5, z=119).ghost(), STEEL, gloss=0.7),
    )


def _juice_box(rng: Generator) -> Parts:
    print_ = printing.label(ORANGE, GREEN, WHITE, rng)
    straw = tube([(10, 0, 115), (10, 0, 140), (2, 0, 148)], 2.5, sides=6)
    return (Part("body", box(60, 40, 116), ORANGE, print_), Part("straw", straw, WHITE))


def _milk_carton(rng: Generator) -> Parts:
    gable = prism([(-32, 0), (32, 0), (2, 36), (-2, 36)], 64).turn("x", 90).at(y=32, z=120)
    return (
        Part("body", box(64, 64, 120), WHITE, printing.label(WHITE, BLUE, BLUE, rng)),
        Part("gable", gable, WHITE),
        Part("rim", box(4, 64, 12).at(z=156), BLUE),
    )


def _chips_can(rng: Generator) -> Parts:
    print_ = printing.label(RED, YELLOW, WHITE, rng, repeats=2)
    return (
        Part("body", rod(34, 190, 24), RED, print_, "cylinder", 0.4),
        Part("cap", rod(35, 8, 24).at(z=190), CREAM),
    )


def _potted_meat(rng: Generator) -> Parts:
    outline = [(45, 14), (31, 26), (-31, 26), (-45, 14), (-45, -14), (-31, -26), (31, -26), (45, -14)]
    return (
        Part("body", prism(outline, 76).at(z=4), NAVY, printing.label(BLUE, YELLOW, WHITE, rng), "box", 0.3),
        Part("bottom", prism(outline, 4), STEEL, gloss=0.7),
        Part("rim", prism(outline, 4).at(z=80), STEEL, gloss=0.7),
    )


def _donut(rng: Generator) -> Parts:
    icing = printing.speckles(PINK, WHITE, 60, rng, 2)
    return (
        Part("body", ring(24, 13.5).at(z=13.5), (190, 130, 70)),
        Part("icing", ring(24, 13).at(z=15.5).ghost(), PINK, icing, "box", 0.5),
    )


ENTRIES = (
    Entry("cracker box", "box", ("red",), 0.41, 0.6, carton(60, 155, 205, RED, YELLOW, WHITE)),
    Entry("sugar box", "box", ("yellow",), 0.5, 0.6, carton(90, 40, 172, YELLOW, WHITE, BLUE)),
    Entry("white sugar box", "box", ("white",), 0.45, 0.6, carton(85, 44, 135, WHITE, SKY, BLUE)),
    Entry("pudding box", "box", ("brown",), 0.19, 0.6, carton(108, 35, 86, DARK_BROWN, CREAM, WHITE)),
    Entry("gelatin box", "box", ("red",), 0.1, 0.6, carton(84, 68, 28, RED, WHITE, WHITE)),
    Entry("pink tea box", "box", ("pink",), 0.12, 0.6, carton(110, 64, 70, PINK, WHITE, RED)),
    Entry("pasta box", "box", ("blue",), 0.45, 0.6, carton(80, 38, 180, BLUE, YELLOW, WHITE)),
    Entry("tomato soup can", "can", ("red", "white"), 0.35, 0.55, can(33.5, 101, RED, WHITE, WHITE)),
    Entry("tuna can", "can", ("grey", "blue"), 0.17, 0.55, can(36, 34, BLUE, WHITE, YELLOW)),
    Entry("corn can", "can", ("green",), 0.34, 0.55, can(36, 98, GREEN, YELLOW, WHITE)),
    Entry("potted meat can", "can", ("blue", "yellow"), 0.37, 0.55, _potted_meat),
    Entry("chips can", "can", ("red",), 0.2, 0.6, _chips_can),
    Entry("soda can", "beverage", ("red",), 0.35, 0.55, _soda_can),
    Entry("juice box", "carton", ("orange",), 0.24, 0.6, _juice_box),
    Entry("milk carton", "carton", ("white", "blue"), 0.5, 0.6, _milk_carton),
    Entry("donut", "food", ("pink", "brown"), 0.06, 0.7, _donut),
    Entry("egg", "food", ("white",), 0.06, 0.6, lambda rng: (Part("body", egg(22, 22, 28).turn("y", 90), WHITE),)),
    Entry("chocolate", "food", ("brown",), 0.1, 0.6, carton(150, 62, 12, BROWN, YELLOW, LIME)),
)
