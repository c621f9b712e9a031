"""Cups, mugs, bowls, dishes: hollow things that are taken by the rim or the handle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import BLUE, GREEN, RED, SKY, WHITE, YELLOW
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import Solid, box, rod, total, tube, turned, vessel

_GLAZE = 0.5
_FOOT = 9.0
"""Height of a foot ring [mm]."""


def _with_rim(profile: list[tuple[float, float]], wall: float, color: RGB, rim: RGB | None = None) -> Parts:
    """A vessel whose uppermost 8 mm are its rim; the body carries the collisions of both."""
    whole = vessel(profile, wall)
    (low_r, low_z), (top_r, top_z) = profile[-2:]
    at = top_z - 8.0
    edge = (float(np.interp(at, [low_z, top_z], [low_r, top_r])), at)
    body = Solid(vessel([*profile[:-1], edge], wall).surface, whole.collisions)
    return (
        Part("body", body, color, gloss=_GLAZE),
        Part("rim", vessel([edge, profile[-1]], wall, None).ghost(), rim or color, gloss=_GLAZE),
    )


def _footed(parts: Parts, radius: float) -> Parts:
    """Stand a vessel on a foot ring: what a gripper can hold it by when it lies upside down."""
    body, *others = (replace(part, solid=part.solid.at(z=_FOOT - 1)) for part in parts)
    foot = turned([(radius, 0), (radius - 1, _FOOT)], sides=32)
    return (replace(body, solid=body.solid + foot), *others)


def _cup(bottom: float, top: float, height: float, color: RGB, rim: RGB | None = None) -> Build:
    return lambda rng: _with_rim([(bottom, 0), (top, height)], 3.5, color, rim)


def _bowl(color: RGB, rim: RGB | None = None) -> Build:
    return lambda rng: _footed(_with_rim([(34, 0), (54, 16), (75, 52)], 4.0, color, rim), 31)


def _handle(radius: float, low: float, high: float, reach: float) -> Solid:
    """A bow from (radius, low) to (radius, high) that stands off by `reach`."""
    angle = np.radians(np.linspace(-90, 90, 9))
    middle, half = (low + high) / 2, (high - low) / 2
    bow = np.column_stack([radius + reach * np.cos(angle), 0 * angle, middle + half * np.sin(angle)])
    return tube(np.concatenate([[(radius - 1, 0, low)], bow, [(radius - 1, 0, high)]]), 5.5)


def _mug(color: RGB, stripe: RGB) -> Build:
    band = vessel([(40.8, 36), (41.1, 56)], 1.0, None).ghost()
    handle = _handle(39, 20, 70, 26)

    def build(rng: Generator) -> Parts:
        return (
            *_with_rim([(40, 0), (41, 88)], 4.0, color),
            Part("stripe", band, stripe, gloss=_GLAZE),
            Part("handle", handle, color, gloss=_GLAZE),
        )

    return build


def _tea_cup(rng: Generator) -> Parts:
    body, rim = _with_rim([(27, 0), (41, 52)], 3.5, WHITE, BLUE)
    return (body, rim, Part("handle", _handle(37, 16, 42, 18), WHITE, gloss=_GLAZE))


def _plate(rng: Generator) -> Parts:
    return _footed(_with_rim([(56, 0), (80, 15)], 4.5, WHITE, SKY), 33)


def _dish(rng: Generator) -> Parts:
    return _footed(_with_rim([(50, 0), (68, 22)], 4.5, GREEN, WHITE), 33)


def _vase(rng: Generator) -> Parts:
    return _with_rim([(28, 0), (36, 40), (22, 100), (28, 130)], 4.0, BLUE, WHITE)


def _pitcher_lid(rng: Generator) -> Parts:
    grip = box(58, 10, 16, 3).at(z=10)
    return (
        Part("body", turned([(54, 0), (54, 8), (48, 12)], sides=32), BLUE, gloss=0.4),
        Part("handle", grip, BLUE, gloss=0.4),
    )


def _soap_dish(rng: Generator) -> Parts:
    wall = 4.0
    sides = total(
        [
            box(120, wall, 26).at(y=40 - wall / 2),
            box(120, wall, 26).at(y=-40 + wall / 2),
            box(wall, 80 - 2 * wall, 26).at(x=60 - wall / 2),
            box(wall, 80 - 2 * wall, 26).at(x=-60 + wall / 2),
        ]
    )
    ribs = total([box(104, 4, 3).at(y=y, z=5) for y in (-20, 0, 20)])
    return (
        Part("body", box(112, 72, 5), SKY, gloss=0.4),
        Part("rim", sides, SKY, gloss=0.4),
        Part("ribs", ribs, WHITE),
    )


def _wine_glass(rng: Generator) -> Parts:
    bowl = vessel([(12, 70), (32, 105), (29, 150)], 3.5)
    return (
        Part("foot", turned([(32, 0), (31, 4), (6, 8)]), (215, 222, 226), gloss=0.9),
        Part("stem", rod(5, 64, 10).at(z=7), (215, 222, 226), gloss=0.9),
        Part("rim", bowl, (215, 222, 226), gloss=0.9),
    )


ENTRIES = (
    Entry("mug", "drinkware", ("white", "red"), 0.35, 0.6, _mug(WHITE, RED)),
    Entry("green mug", "drinkware", ("green",), 0.35, 0.6, _mug(GREEN, WHITE)),
    Entry("blue cup", "drinkware", ("blue",), 0.06, 0.6, _cup(29, 38, 92, BLUE)),
    Entry("yellow cup", "drinkware", ("yellow",), 0.05, 0.6, _cup(27, 35, 78, YELLOW)),
    Entry("red cup", "drinkware", ("red",), 0.05, 0.6, _cup(28, 40, 100, RED, WHITE)),
    Entry("tea cup", "drinkware", ("white",), 0.16, 0.6, _tea_cup),
    Entry("bowl", "tableware", ("red",), 0.15, 0.6, _bowl(RED, WHITE)),
    Entry("yellow bowl", "tableware", ("yellow",), 0.14, 0.6, _bowl(YELLOW)),
    Entry("plate", "tableware", ("white", "blue"), 0.3, 0.6, _plate),
    Entry("dish", "tableware", ("green",), 0.2, 0.6, _dish),
    Entry("pitcher lid", "tableware", ("blue",), 0.08, 0.6, _pitcher_lid),
    Entry("vase", "container", ("blue",), 0.4, 0.6, _vase),
    Entry("soap dish", "container", ("blue",), 0.08, 0.6, _soap_dish),
    Entry("wine glass", "drinkware", ("white",), 0.15, 0.5, _wine_glass),
)
