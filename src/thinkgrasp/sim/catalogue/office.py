"""Stationery and small electronics."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import (
    BLACK,
    BLUE,
    BRASS,
    CREAM,
    DARK_GREY,
    GREEN,
    GREY,
    NAVY,
    PINK,
    RED,
    STEEL,
    TAN,
    WHITE,
    YELLOW,
)
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import arc, box, loft, prism, rod, taper, total, tube, vessel


def _marker(color: RGB, barrel: RGB, radius: float) -> Build:
    def build(rng: Generator) -> Parts:
        return (
            Part("body", rod(radius, 76).turn("y", 90), barrel, gloss=0.4),
            Part("cap", rod(radius + 0.8, 46).turn("y", 90).at(x=76), color, gloss=0.4),
            Part("clip", box(34, 4, 2.5).at(x=98, z=radius).ghost(), color),
            Part("end", rod(radius - 0.5, 8).turn("y", 90).at(x=-8), color),
        )

    return build


def _pen(rng: Generator) -> Parts:
    return (
        Part("body", rod(5, 110, 12).turn("y", 90), BLUE, gloss=0.5),
        Part("tip", taper(5, 1.5, 14, sides=10).turn("y", -90), STEEL, gloss=0.7),
        Part("clip", box(32, 3, 3).at(x=92, z=5), STEEL, gloss=0.7),
        Part("button", rod(3, 10, 8).turn("y", 90).at(x=110), STEEL, gloss=0.7),
    )


def _scissors(rng: Generator) -> Parts:
    blade = prism([(-14, -7), (70, -3), (82, 0), (70, 7), (-14, 7)], 5)
    loop = tube(arc(22, 0, 360, 13, squash=0.75)[:-1], 6, closed=True)
    handles = total([loop.turn("z", -14 * s).at(x=-52, y=21 * s, z=6) for s in (-1, 1)])
    arms = total([tube([(-10, 0, 6), (-34, 13 * s, 6)], 6) for s in (-1, 1)])
    return (
        Part("blade", blade.turn("z", 4).at(z=1) + blade.turn("z", -4).at(z=6), STEEL, gloss=0.7),
        Part("handle", handles + arms, RED),
        Part("joint", rod(5, 3, 10).at(z=11), DARK_GREY),
    )


def _tape(rng: Generator) -> Parts:
    return (
        Part("body", vessel([(46, 0), (46, 24)], 12, None), TAN, gloss=0.5),
        Part("core", vessel([(34, 0), (34, 24)], 3.5, None), CREAM),
    )


def _stapler(rng: Generator) -> Parts:
    return (
        Part("base", box(130, 34, 12, 3), BLACK),
        Part("body", prism([(-62, 0), (62, 0), (62, 14), (-40, 30), (-62, 30)], 30).turn("x", 90).at(y=15, z=14), BLUE),
        Part("joint", box(22, 24, 8).at(x=-48, z=10), BLACK),
    )


def _box_cutter(rng: Generator) -> Parts:
    return (
        Part("handle", box(126, 24, 16, 3), YELLOW),
        Part("slider", box(20, 9, 5).at(x=28, z=16), BLACK),
        Part("blade", prism([(0, -8), (26, -8), (16, 8), (0, 8)], 3).at(x=62, z=6.5), STEEL, gloss=0.7),
    )


def _glue_stick(rng: Generator) -> Parts:
    print_ = printing.label(YELLOW, RED, NAVY, rng, repeats=2)
    return (
        Part("body", rod(14, 66), YELLOW, print_, "cylinder", 0.3),
        Part("cap", rod(14.8, 30).at(z=66), WHITE),
    )


def _eraser(rng: Generator) -> Parts:
    return (
        Part("body", box(60, 26, 16, 2.5), PINK),
        Part("sleeve", box(34, 27, 17).at(x=13, z=-0.5), WHITE, printing.label(WHITE, BLUE, BLUE, rng)),
    )


def _notebook(rng: Generator) -> Parts:
    picture = printing.label(GREEN, YELLOW, WHITE, rng)
    return (
        Part("cover", box(68, 110, 2.5), GREEN, gloss=0.3),
        Part("pages", box(64, 106, 13).at(z=2.5), CREAM),
        Part("spine", box(2, 110, 13).at(x=-33, z=2.5), GREEN),
        Part("cover", box(68, 110, 2.5).at(z=15.5), GREEN, picture, gloss=0.3),
    )


def _remote(rng: Generator) -> Parts:
    keys = printing.buttons(BLACK, GREY, RED, 9, 3)
    return (
        Part("body", box(168, 46, 20, 4), BLACK),
        Part("buttons", box(150, 36, 1).at(z=19.6).ghost(), BLACK, keys),
    )


def _mouse(color: RGB, wheel: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        shell = loft([(0, 52, 29, 0), (8, 54, 31, 0), (22, 48, 28, -2), (31, 32, 20, -6), (35, 14, 9, -8)], power=2.5)
        return (
            Part("body", shell, color, gloss=0.3),
            Part("wheel", rod(9, 6, 14).turn("x", 90).at(x=26, y=3, z=24), wheel),
        )

    return build


def _phone(rng: Generator) -> Parts:
    return (
        Part("body", box(146, 70, 9, 1.5), DARK_GREY, gloss=0.4),
        Part("screen", box(136, 63, 0.6).at(z=8.8).ghost(), BLACK, gloss=0.9),
    )


def _battery(rng: Generator) -> Parts:
    return (
        Part("body", rod(16.5, 38, 20), BLACK, gloss=0.5),
        Part("top", rod(16.5, 18, 20).at(z=38), BRASS, gloss=0.7),
        Part("pole", rod(5, 4, 12).at(z=56), STEEL, gloss=0.7),
    )


def _calculator(rng: Generator) -> Parts:
    keys = printing.buttons(DARK_GREY, WHITE, RED, 5, 4)
    return (
        Part("body", box(130, 68, 14, 3), DARK_GREY),
        Part("screen", box(30, 54, 1).at(x=42, z=13.6).ghost(), (168, 190, 160), gloss=0.6),
        Part(
            "buttons",
            box(84, 58, 1).at(x=-18, z=13.6).ghost(),
            DARK_GREY,
            keys,
        ),
    )


def _light_bulb(rng: Generator) -> Parts:
    glass = taper(29, 15, 42, sides=18).turn("y", 90)
    return (
        Part("glass", glass, (236, 236, 228), gloss=0.7),
        Part("base", rod(13.5, 26).turn("y", 90).at(x=54), STEEL, gloss=0.7),
    )


ENTRIES = (
    Entry("black marker", "stationery", ("black",), 0.03, 0.6, _marker(BLACK, BLACK, 9)),
    Entry("red marker", "stationery", ("red",), 0.03, 0.6, _marker(RED, RED, 9)),
    Entry("marker", "stationery", ("white", "blue"), 0.025, 0.6, _marker(BLUE, WHITE, 10)),
    Entry("pen", "stationery", ("blue", "grey"), 0.015, 0.65, _pen),
    Entry("scissors", "stationery", ("red", "grey"), 0.09, 0.55, _scissors),
    Entry("tape", "stationery", ("brown",), 0.14, 0.65, _tape),
    Entry("stapler", "stationery", ("blue", "black"), 0.2, 0.6, _stapler),
    Entry("box cutter", "stationery", ("yellow",), 0.08, 0.6, _box_cutter),
    Entry("glue stick", "stationery", ("white", "yellow"), 0.05, 0.6, _glue_stick),
    Entry("eraser", "stationery", ("white", "pink"), 0.03, 0.8, _eraser),
    Entry("notebook", "stationery", ("green", "white"), 0.12, 0.6, _notebook),
    Entry("remote control", "electronics", ("black",), 0.13, 0.6, _remote),
    Entry("white computer mouse", "electronics", ("white",), 0.09, 0.55, _mouse(WHITE, DARK_GREY)),
    Entry("black computer mouse", "electronics", ("black",), 0.09, 0.55, _mouse(BLACK, GREY)),
    Entry("phone", "electronics", ("black",), 0.17, 0.6, _phone),
    Entry("battery", "electronics", ("yellow", "black"), 0.14, 0.55, _battery),
    Entry("calculator", "electronics", ("grey", "white"), 0.1, 0.6, _calculator),
    Entry("light bulb", "electronics", ("white",), 0.05, 0.55, _light_bulb),
)
