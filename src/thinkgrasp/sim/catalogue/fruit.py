"""Fruit and vegetables."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import (
    BROWN,
    DARK_BROWN,
    GREEN,
    LEAF,
    LIME,
    ORANGE,
    PURPLE,
    RED,
    TAN,
    YELLOW,
)
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import Solid, arc, ball, egg, leaf, rod, taper, total, tube, turned

PEACH = (250, 160, 80)
PLUM = (96, 34, 92)


def _stalk(z: float, color: RGB = DARK_BROWN, length: float = 10) -> Part:
    return Part("stalk", rod(1.8, length, sides=6).at(z=z).ghost(), color)


def _round(shape: Solid, color: RGB, spots: RGB, *, count: int = 60, stalk_z: float | None = None) -> Build:
    def build(rng: Generator) -> Parts:
        body = Part("body", shape, color, printing.speckles(color, spots, count, rng), "sphere", gloss=0.3)
        return (body,) if stalk_z is None else (body, _stalk(stalk_z))

    return build


def _flushed(shape: Solid, color: RGB, flush: RGB, share: float, stalk_z: float) -> Build:
    def build(rng: Generator) -> Parts:
        return (
            Part("body", shape, color, printing.blush(color, flush, share), "cylinder", gloss=0.15),
            _stalk(stalk_z, length=6),
        )

    return build


def _apple() -> Solid:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    r, z = 35.5 * np.cos(angle).round(12), 32 * np.sin(angle)
    z = np.where(z > 0, z - 3.5 * np.exp(-((r / 12) ** 2)), z)
    return Solid(turned(np.column_stack([r, z])[1:-1]).surface, egg(35.5, 35.5, 32).collisions)


def _pear() -> Solid:
    return taper(34, 18, 48, sides=20)


def _banana(rng: Generator) -> Parts:
    path = arc(95, -50, 50, 11)
    radii = np.array([8, 12.5, 15, 16.5, 17, 17.5, 17, 16.5, 15, 12, 8.0])
    tip = path[-1] + 6 * np.array([-np.sin(np.radians(50)), np.cos(np.radians(50)), 0])
    return (
        Part("body", tube(path, radii, sides=10).at(x=-82), YELLOW, gloss=0.2),
        Part("stalk", tube([path[-1], tip, tip + np.array([-9, 7, 0])], 5.5, sides=8).at(x=-82), LEAF),
    )


def _strawberry(rng: Generator) -> Parts:
    leaves = total([leaf(17, 8).turn("y", 15).turn("z", a) for a in range(0, 360, 60)]).at(z=33)
    body = taper(6, 16, 18, sides=16)
    return (
        Part("body", body, RED, printing.speckles(RED, YELLOW, 70, rng, 0.9), "sphere", gloss=0.4),
        Part("leaf", leaves, GREEN),
    )


def _lemon() -> Solid:
    profile = [(3, -41), (6, -37), (15, -31), (24, -20), (27.5, -7), (27.5, 7), (24, 20), (15, 31), (6, 37), (3, 41)]
    return turned(profile).turn("y", 90)


def _carrot(rng: Generator) -> Parts:
    body = taper(17, 5, 140).turn("y", 90)
    tops = total([tube([(0, 0, 0), (-18, dy, 4), (-30, 2 * dy, 3)], 2.6, sides=6) for dy in (-5, 0, 5)]).at(x=-14)
    return (Part("body", body, ORANGE, gloss=0.15), Part("leaf", tops, GREEN))


def _cucumber(rng: Generator) -> Parts:
    path = arc(420, -12, 12, 7) - [420, 0, 0]
    return (Part("body", tube(path, [15, 19, 21, 21.5, 21, 19, 15], sides=12), (45, 110, 50), gloss=0.3),)


def _eggplant(rng: Generator) -> Parts:
    body = taper(33, 20, 85, sides=18).turn("y", 90)
    cap = total([taper(9, 20.8, 12, sides=12).at(z=-14), rod(5, 18, sides=8).at(z=-34)]).turn("y", -90).at(x=88)
    return (Part("body", body, (66, 30, 78), gloss=0.6), Part("cap", cap, LEAF))


def _tomato(rng: Generator) -> Parts:
    leaves = total([leaf(20, 7).turn("y", 10).turn("z", a) for a in range(0, 360, 72)]).at(z=28)
    return (Part("body", egg(34, 34, 28), (214, 40, 28), gloss=0.5), Part("leaf", leaves, GREEN))


def _bell_pepper(rng: Generator) -> Parts:
    profile = [(14, -42), (24, -36), (31, -15), (34.5, 10), (34.5, 22), (28, 32), (12, 33)]
    return (
        Part("body", turned(profile), GREEN, gloss=0.5),
        Part("stalk", tube([(0, 0, 32), (0, 0, 42), (4, 0, 50)], 4), LEAF),
    )


def _corn(rng: Generator) -> Parts:
    cob = taper(23, 13, 110, sides=18).turn("y", 90)
    husk = total([egg(38, 12, 5, sides=10).at(z=22).turn("y", -8).turn("x", a) for a in (-70, 0, 70)]).at(x=-12)
    rows = printing.squares((240, 200, 45), (214, 160, 30), 12)
    return (Part("body", cob, YELLOW, rows, "box"), Part("leaf", husk, LIME))


ENTRIES = (
    Entry("apple", "fruit", ("red",), 0.16, 0.6, _round(_apple(), RED, (212, 60, 45), stalk_z=26)),
    Entry("green apple", "fruit", ("green",), 0.15, 0.6, _round(_apple(), LIME, (165, 205, 80), stalk_z=26)),
    Entry("banana", "fruit", ("yellow",), 0.12, 0.7, _banana),
    Entry("strawberry", "fruit", ("red",), 0.025, 0.7, _strawberry),
    Entry("lemon", "fruit", ("yellow",), 0.11, 0.65, _round(_lemon(), (248, 215, 45), (232, 190, 30), count=120)),
    Entry("lime", "fruit", ("green",), 0.07, 0.65, _round(egg(28, 24, 24), (95, 155, 50), (80, 135, 40), count=120)),
    Entry("peach", "fruit", ("orange", "red"), 0.15, 0.75, _flushed(egg(34.5, 34.5, 33), PEACH, RED, 0.35, 30)),
    Entry("pear", "fruit", ("green",), 0.17, 0.65, _round(_pear(), (170, 190, 65), (155, 172, 58), stalk_z=64)),
    Entry("orange", "fruit", ("orange",), 0.18, 0.65, _round(ball(35.5), ORANGE, (225, 115, 15), count=140)),
    Entry("plum", "fruit", ("purple",), 0.07, 0.6, _round(egg(27, 25, 25), PLUM, PURPLE, stalk_z=22)),
    Entry("mango", "fruit", ("orange", "red"), 0.3, 0.65, _flushed(egg(52, 35, 32), (240, 150, 35), RED, 0.35, 28)),
    Entry("kiwi", "fruit", ("brown",), 0.09, 0.8, _round(egg(33, 25, 25), BROWN, TAN, count=200)),
    Entry("avocado", "fruit", ("green",), 0.2, 0.7, _round(taper(31, 19, 40, sides=20), (52, 84, 38), (40, 62, 30))),
    Entry("tomato", "vegetable", ("red",), 0.12, 0.6, _tomato),
    Entry("carrot", "vegetable", ("orange", "green"), 0.1, 0.65, _carrot),
    Entry("cucumber", "vegetable", ("green",), 0.2, 0.65, _cucumber),
    Entry("eggplant", "vegetable", ("purple", "green"), 0.25, 0.6, _eggplant),
    Entry("potato", "vegetable", ("brown",), 0.19, 0.7, _round(egg(48, 33, 28), (150, 104, 60), BROWN, count=40)),
    Entry("bell pepper", "vegetable", ("green",), 0.15, 0.6, _bell_pepper),
    Entry("corn", "vegetable", ("yellow", "green"), 0.22, 0.65, _corn),
)
