"""Toy animals: a body, legs, a neck, a head, and what makes the animal."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLACK, BROWN, GREY, ORANGE, PINK, TAN, WHITE, YELLOW
from thinkgrasp.sim.catalogue.solid import Solid, egg, taper, total, tube, turned

_GOLD = (212, 132, 52)
_HIDE = (134, 136, 140)
_FUR = (48, 42, 42)


def _egg(a: float, b: float, c: float) -> Solid:
    return egg(a, b, c, sides=10)


def _legs(length: float, radius: float, x: float, y: float) -> Solid:
    """Four legs of this length that stand on z = 0."""
    leg = turned([(radius, 0), (radius + 1, length)], sides=8)
    return total([leg.at(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)])


def _eyes(x: float, y: float, z: float) -> Part:
    return Part("eye", total([egg(2.2, 2.2, 2.2, sides=6).at(x, s * y, z) for s in (-1, 1)]).ghost(), BLACK)


def _elephant(rng: Generator) -> Parts:
    ears = total([_egg(4, 15, 17).turn("z", -25 * s).at(38, 22 * s, 70) for s in (-1, 1)])
    trunk = tube([(58, 0, 60), (70, 0, 44), (72, 0, 22), (80, 0, 12)], [9, 8, 6.5, 6])
    tusks = total([tube([(60, 9 * s, 52), (76, 11 * s, 46)], 2.5, sides=6) for s in (-1, 1)])
    return (
        Part("body", _egg(46, 30, 29).at(z=56), _HIDE),
        Part("leg", _legs(46, 10, 26, 16), _HIDE),
        Part("head", _egg(21, 20, 21).at(x=48, z=68), _HIDE),
        Part("ear", ears, GREY),
        Part("trunk", trunk, _HIDE),
        Part("tusk", tusks, WHITE),
        _eyes(64, 11, 76),
    )


def _rhinoceros(rng: Generator) -> Parts:
    horns = taper(6, 1.5, 20, sides=8).turn("y", 25).at(76, 0, 52) + taper(4, 1.5, 9, sides=8).at(64, 0, 56)
    return (
        Part("body", _egg(48, 27, 27).at(z=46), GREY),
        Part("leg", _legs(38, 9, 28, 13), GREY),
        Part("head", taper(17, 12, 28, sides=10).turn("y", 100).at(x=46, z=50), GREY),
        Part("horn", horns, WHITE),
        Part("ear", total([_egg(3, 4, 7).at(44, 12 * s, 68) for s in (-1, 1)]), GREY),
        _eyes(60, 13, 54),
    )


def _lion(rng: Generator) -> Parts:
    return (
        Part("body", taper(22, 19, 60, sides=12).turn("y", -90).at(x=26, z=52), _GOLD),
        Part("leg", _legs(44, 8, 27, 12), _GOLD),
        Part("mane", _egg(15, 26, 27).at(x=40, z=68), BROWN),
        Part("head", _egg(17, 17, 17).at(x=52, z=70), _GOLD),
        Part("tail", tube([(-50, 0, 56), (-66, 0, 46), (-74, 0, 54)], 3.5, sides=6), _GOLD),
        Part("tuft", _egg(7, 5, 5).at(-76, 0, 58), BROWN),
        _eyes(66, 7, 75),
    )


def _gorilla(rng: Generator) -> Parts:
    arms = total([tube([(12, 25 * s, 72), (22, 34 * s, 44), (26, 30 * s, 10)], [11, 10, 9]) for s in (-1, 1)])
    legs = total([tube([(-18, 15 * s, 34), (-14, 19 * s, 11)], [13, 11]) for s in (-1, 1)])
    return (
        Part("body", taper(24, 27, 34, sides=12).turn("y", 25).at(x=-12, z=40), _FUR, gloss=0.1),
        Part("arm", arms, _FUR, gloss=0.1),
        Part("leg", legs, _FUR, gloss=0.1),
        Part("head", _egg(18, 17, 20).at(x=16, z=98), _FUR, gloss=0.1),
        Part("face", _egg(8, 11, 12).at(x=28, z=95), (92, 78, 72)),
        _eyes(35, 5, 100),
    )


def _camel(rng: Generator) -> Parts:
    humps = taper(14, 8, 16, sides=10).at(-16, 0, 74) + taper(14, 8, 16, sides=10).at(14, 0, 74)
    return (
        Part("body", _egg(42, 21, 21).at(z=64), TAN),
        Part("hump", humps, BROWN),
        Part("leg", _legs(56, 6.5, 24, 10), TAN),
        Part("neck", tube([(34, 0, 66), (54, 0, 72), (60, 0, 96)], [10, 9, 7.5]), TAN),
        Part("head", taper(10, 7, 18, sides=8).turn("y", 100).at(x=60, z=106), TAN),
        _eyes(66, 8, 108),
    )


def _giraffe(rng: Generator) -> Parts:
    spots = printing.speckles(YELLOW, BROWN, 60, rng, 5)
    horns = total([tube([(50, 5 * s, 158), (48, 6 * s, 170)], 2.5, sides=6) for s in (-1, 1)])
    return (
        Part("body", _egg(36, 19, 20).at(z=68), YELLOW, spots, "box"),
        Part("leg", _legs(60, 6, 21, 9), YELLOW),
        Part("neck", tube([(24, 0, 76), (40, 0, 112), (48, 0, 148)], [12, 9, 8]), YELLOW, spots, "box"),
        Part("head", taper(10, 6.5, 20, sides=8).turn("y", 110).at(x=50, z=152), YELLOW),
        Part("horn", horns, BROWN),
        _eyes(56, 8, 154),
    )


def _pig(rng: Generator) -> Parts:
    rose = (244, 150, 178)
    return (
        Part("body", _egg(42, 30, 29).at(z=42), rose),
        Part("leg", _legs(24, 8, 22, 14), rose),
        Part("head", _egg(21, 20, 20).at(x=40, z=48), rose),
        Part("snout", taper(9, 9, 6, sides=10).turn("y", 90).at(x=56, z=45), PINK),
        Part("ear", total([_egg(5, 7, 9).at(38, 13 * s, 66) for s in (-1, 1)]), PINK),
        _eyes(57, 8, 56),
    )


def _duck(rng: Generator) -> Parts:
    return (
        Part("body", _egg(36, 27, 23).at(z=23), YELLOW, gloss=0.4),
        Part("tail", taper(10, 4, 18, sides=8).turn("y", -50).at(x=-26, z=30), YELLOW, gloss=0.4),
        Part("head", _egg(19, 18, 19).at(x=16, z=56), YELLOW, gloss=0.4),
        Part("beak", _egg(11, 9, 4).at(x=37, z=52), ORANGE, gloss=0.4),
        _eyes(31, 9, 62),
    )


def _zebra(rng: Generator) -> Parts:
    coat = printing.stripes((WHITE, WHITE, WHITE, BLACK, BLACK), 6)
    return (
        Part("body", taper(22, 20, 50, sides=12).turn("y", -90).at(x=24, z=60), WHITE, coat),
        Part("leg", _legs(54, 7, 26, 11), WHITE),
        Part(
            "neck",
            tube([(30, 0, 66), (46, 0, 84), (52, 0, 98)], [14, 12, 10]),
            WHITE,
            printing.bands(tuple((1.0, c) for c in (WHITE, BLACK) * 3)),
        ),
        Part("head", taper(13, 9, 24, sides=10).turn("y", 110).at(x=54, z=102), WHITE),
        Part("mane", tube([(28, 0, 84), (40, 0, 106), (50, 0, 117)], 4, sides=6), BLACK),
        _eyes(62, 11, 104),
    )


ENTRIES = (
    Entry("elephant", "animal", ("grey",), 0.15, 0.6, _elephant),
    Entry("rhinoceros", "animal", ("grey",), 0.14, 0.6, _rhinoceros),
    Entry("lion", "animal", ("orange", "brown"), 0.12, 0.6, _lion),
    Entry("gorilla", "animal", ("black",), 0.14, 0.6, _gorilla),
    Entry("camel", "animal", ("brown",), 0.12, 0.6, _camel),
    Entry("giraffe", "animal", ("yellow", "brown"), 0.1, 0.6, _giraffe),
    Entry("zebra", "animal", ("white", "black"), 0.12, 0.6, _zebra),
    Entry("pig", "animal", ("pink",), 0.14, 0.6, _pig),
    Entry("duck", "animal", ("yellow",), 0.05, 0.65, _duck),
)
