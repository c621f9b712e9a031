"""Bottles, tubes and sprays."""

from __future__ import annotations

from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import (
    BLACK,
    BLUE,
    GREEN,
    LEAF,
    LIME,
    NAVY,
    PALE_YELLOW,
    PINK,
    PURPLE,
    RED,
    SKY,
    TAN,
    WHITE,
    YELLOW,
)
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import Solid, box, loft, rod, tube, turned


def _capped(body: Solid, top: float, cap: Solid, colors: tuple[RGB, RGB, RGB, RGB], repeats: int = 2) -> Build:
    """A body with a label and a cap at height `top`; colours of body, cap, label panel and ink."""
    base, cap_color, accent, ink = colors

    def build(rng: Generator) -> Parts:
        print_ = printing.label(base, accent, ink, rng, repeats=repeats, height=144)
        return (
            Part("body", body, base, print_, "cylinder", 0.4),
            Part("cap", cap.at(z=top), cap_color, gloss=0.4),
        )

    return build


def _flask(a: float, b: float, shoulder: float, top: float, neck: float, power: float = 2.0) -> Solid:
    """A bottle with half sides a and b up to its shoulder, narrowing to its neck at the top."""
    middle = (shoulder + top) / 2
    sections = [
        (0, a - 2, b - 2),
        (3, a, b),
        (shoulder, a, b),
        (middle, 0.75 * a + 0.25 * neck, 0.75 * b + 0.25 * neck),
        (top, neck, neck),
    ]
    return loft(sections, power=power)


def _squeeze_tube(a: float, b: float, height: float) -> Solid:
    """A tube that stands on its cap: round below, pressed flat at the top."""
    return loft([(0, a, b), (0.3 * height, a, 0.9 * b), (height - 8, a + 4, 4), (height, a + 4, 3)])


def _standing_tube(a: float, b: float, height: float, base: RGB, cap: RGB, accent: RGB, ink: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        print_ = printing.label(base, accent, ink, rng, repeats=2, height=144)
        return (
            Part("cap", loft([(0, a - 2, b - 2), (24, a - 1, b - 1)]), cap, gloss=0.4),
            Part("body", _squeeze_tube(a, b, height - 24).at(z=24), base, print_, "cylinder", 0.4),
        )

    return build


def _spray(rng: Generator) -> Parts:
    body = _flask(33, 26, 95, 135, 14)
    trigger = tube([(13, 0, 150), (19, 0, 138), (18, 0, 122)], 3.5)
    head = box(56, 24, 24, 4).at(x=8, z=143)
    return (
        Part("body", body, GREEN, printing.label(GREEN, YELLOW, WHITE, rng, repeats=2, height=144), "cylinder", 0.4),
        Part("neck", rod(13, 9).at(z=135), WHITE),
        Part("head", head, WHITE),
        Part("nozzle", rod(6, 9, 10).turn("y", 90).at(x=36, z=157), RED),
        Part("trigger", trigger, RED),
    )


def _repellent(rng: Generator) -> Parts:
    return (
        Part(
            "body",
            rod(27, 135, 24),
            LEAF,
            printing.label(GREEN, YELLOW, WHITE, rng, repeats=2, height=144),
            "cylinder",
            0.5,
        ),
        Part("shoulder", turned([(27, 135), (20, 146)]), WHITE),
        Part("cap", turned([(20, 146), (20, 178), (16, 183)]), YELLOW),
    )


def _pump(base: RGB, accent: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        print_ = printing.label(base, accent, WHITE, rng, repeats=2, height=144)
        pump = _pump_head()
        return (
            Part("body", _flask(31, 31, 100, 122, 14), base, print_, "cylinder", 0.4),
            Part("cap", rod(15, 14).at(z=122), WHITE),
            Part("pump", pump.at(z=136), WHITE),
        )

    return build


def _pump_head() -> Solid:
    """The stem and spout of a hand pump."""
    return rod(5, 20, 10) + tube([(-10, 0, 24), (12, 0, 25), (30, 0, 20)], 6)


def _blue_moon(rng: Generator) -> Parts:
    return (
        Part(
            "body",
            _flask(38, 27, 110, 150, 15),
            BLUE,
            printing.label(BLUE, WHITE, SKY, rng, repeats=2, height=144),
            "cylinder",
            0.4,
        ),
        Part("cap", turned([(17, 150), (16, 182)]), WHITE),
    )


def _water_bottle(rng: Generator) -> Parts:
    clear = (130, 180, 215)
    return (
        Part("body", turned([(28, 0), (31, 4), (31, 130), (24, 155), (13, 175)]), clear, gloss=0.8),
        Part("label", rod(31.6, 52, 24).at(z=60), BLUE, printing.label(BLUE, WHITE, WHITE, rng, repeats=2), "cylinder"),
        Part("cap", rod(14.5, 18).at(z=175), BLUE),
    )


def _mustard(rng: Generator) -> Parts:
    body = _flask(45, 28, 105, 148, 17)
    return (
        Part("body", body, YELLOW, printing.label(YELLOW, RED, NAVY, rng, repeats=2, height=144), "cylinder", 0.4),
        Part("cap", turned([(17, 148), (15, 160), (6, 172), (4, 188)]), YELLOW),
    )


ENTRIES = (
    Entry("mustard bottle", "condiment", ("yellow",), 0.45, 0.6, _mustard),
    Entry(
        "ketchup bottle",
        "condiment",
        ("red",),
        0.45,
        0.6,
        _capped(
            turned([(28, 0), (30, 4), (30, 90), (27, 120), (15, 155)]),
            155,
            turned([(17, 0), (15, 26)]),
            (RED, WHITE, WHITE, WHITE),
        ),
    ),
    Entry(
        "bleach cleanser",
        "cleaning",
        ("white", "blue"),
        0.6,
        0.6,
        _capped(_flask(46, 31, 130, 175, 15), 175, turned([(17, 0), (15, 32)]), (WHITE, BLUE, BLUE, NAVY)),
    ),
    Entry("blue moon", "cleaning", ("blue", "white"), 0.5, 0.6, _blue_moon),
    Entry("magic clean", "cleaning", ("green", "white"), 0.45, 0.6, _spray),
    Entry("repellent", "cleaning", ("green", "yellow"), 0.3, 0.6, _repellent),
    Entry(
        "shampoo bottle",
        "hygiene",
        ("purple",),
        0.4,
        0.55,
        _capped(_flask(34, 22, 125, 150, 16), 150, rod(17, 24), (PURPLE, WHITE, WHITE, PINK)),
    ),
    Entry(
        "shampoo",
        "hygiene",
        ("white", "green"),
        0.35,
        0.55,
        _capped(_flask(32, 21, 130, 145, 22, 3.0), 145, loft([(0, 24, 20), (28, 22, 18)]), (WHITE, GREEN, LIME, GREEN)),
    ),
    Entry(
        "mouth rinse",
        "hygiene",
        ("green",),
        0.4,
        0.55,
        _capped(_flask(33, 24, 100, 130, 16, 4.0), 130, rod(18, 28), ((60, 170, 120), WHITE, WHITE, GREEN)),
    ),
    Entry(
        "lotion bottle",
        "hygiene",
        ("white",),
        0.3,
        0.6,
        _capped(_flask(29, 29, 105, 128, 14), 128, rod(16, 26), (WHITE, TAN, SKY, NAVY)),
    ),
    Entry("face wash", "hygiene", ("white", "blue"), 0.15, 0.6, _standing_tube(22, 22, 140, WHITE, BLUE, SKY, BLUE)),
    Entry(
        "facial cleanser", "hygiene", ("white", "blue"), 0.15, 0.6, _standing_tube(23, 20, 150, WHITE, NAVY, NAVY, NAVY)
    ),
    Entry("hand soap", "hygiene", ("pink", "white"), 0.35, 0.6, _pump((235, 125, 165), RED)),
    Entry("water bottle", "beverage", ("blue",), 0.5, 0.6, _water_bottle),
    Entry(
        "syrup",
        "condiment",
        ("brown",),
        0.4,
        0.6,
        _capped(
            turned([(29, 0), (31, 4), (31, 80), (13, 120), (13, 140)]),
            140,
            rod(15, 18),
            ((96, 50, 22), YELLOW, PALE_YELLOW, BLACK),
        ),
    ),
)
