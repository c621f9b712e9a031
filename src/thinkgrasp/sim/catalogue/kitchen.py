"""Cutlery and what is used for cooking."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLACK, BLUE, DARK_GREY, GREEN, RED, SKY, STEEL, WHITE
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import box, egg, prism, total, tube, turned

_POLISH = 0.7


def _knife(handle: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        blade = prism([(0, -11), (92, -11), (108, -6), (116, 3), (100, 11), (0, 11)], 3).at(z=5)
        return (
            Part("blade", blade, STEEL, gloss=_POLISH),
            Part("handle", box(96, 22, 13, 4).at(x=-47), handle),
        )

    return build


def _spoon(rng: Generator) -> Parts:
    handle = tube([(22, 0, 6), (55, 0, 10), (100, 0, 9), (140, 0, 5)], [4, 4, 4.5, 5], sides=8)
    return (
        Part("bowl", egg(31, 20, 6).at(z=6), STEEL, gloss=_POLISH),
        Part("handle", handle, STEEL, gloss=_POLISH),
    )


def _fork(rng: Generator) -> Parts:
    tines = total([box(48, 3.6, 4).at(x=-44, y=y, z=3) for y in (-10.2, -3.4, 3.4, 10.2)])
    palm = prism([(-22, -12), (8, -12), (20, -4), (20, 4), (8, 12), (-22, 12)], 4).at(z=3)
    handle = tube([(20, 0, 6), (60, 0, 9), (100, 0, 8), (130, 0, 5)], [3.5, 4, 4.5, 5], sides=8)
    return (
        Part("tines", tines, STEEL, gloss=_POLISH),
        Part("palm", palm, STEEL, gloss=_POLISH),
        Part("handle", handle, STEEL, gloss=_POLISH),
    )


def _spatula(rng: Generator) -> Parts:
    blade = prism([(-75, -32), (-5, -32), (10, -12), (10, 12), (-5, 32), (-75, 32)], 4)
    handle = tube([(4, 0, 5), (30, 0, 14), (125, 0, 16)], [5, 7, 8.5], sides=10)
    return (Part("blade", blade, BLACK), Part("handle", handle, DARK_GREY))


def _peeler(rng: Generator) -> Parts:
    arms = total([tube([(0, 0, 9), (18, 26 * s, 9), (45, 26 * s, 9)], 5, sides=8) for s in (-1, 1)])
    return (
        Part("handle", tube([(-88, 0, 9), (-2, 0, 9)], 9, sides=12), GREEN),
        Part("fork", arms, GREEN),
        Part("blade", box(12, 48, 3).at(x=42, z=8), STEEL, gloss=_POLISH),
    )


def _ice_cube_mould(rng: Generator) -> Parts:
    length, width, high, wall = 150.0, 76.0, 28.0, 4.0
    along = [box(length, wall, high).at(y=y) for y in (-36, 0, 36)]
    across = [box(wall, width, high).at(x=x) for x in (-73, -36.5, 0, 36.5, 73)]
    return (
        Part("floor", box(length, width, 4), SKY),
        Part("rim", total(along + across), BLUE),
    )


def _salt_shaker(rng: Generator) -> Parts:
    return (
        Part("body", turned([(20, 0), (22, 4), (17, 62)]), WHITE, gloss=0.5),
        Part("cap", turned([(17.5, 62), (17.5, 74), (11, 84)]), STEEL, gloss=_POLISH),
    )


def _tongs(rng: Generator) -> Parts:
    arms = total([tube([(-85, 4 * s, 8), (60, 22 * s, 8)], 5, sides=8) for s in (-1, 1)])
    tips = total([box(38, 7, 16, 2).at(x=76, y=23 * s) for s in (-1, 1)])
    return (Part("arms", arms, STEEL, gloss=_POLISH), Part("tips", tips, RED))


ENTRIES = (
    Entry("knife", "cutlery", ("grey", "black"), 0.09, 0.55, _knife(BLACK)),
    Entry("spoon", "cutlery", ("grey",), 0.05, 0.5, _spoon),
    Entry("fork", "cutlery", ("grey",), 0.05, 0.5, _fork),
    Entry("spatula", "kitchenware", ("black",), 0.08, 0.6, _spatula),
    Entry("peeler", "kitchenware", ("green",), 0.06, 0.65, _peeler),
    Entry("ice cube mould", "kitchenware", ("blue",), 0.09, 0.65, _ice_cube_mould),
    Entry("tongs", "kitchenware", ("grey", "red"), 0.09, 0.55, _tongs),
    Entry("salt shaker", "condiment", ("white",), 0.12, 0.55, _salt_shaker),
)
