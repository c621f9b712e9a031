"""Random household-like things for rendered scenes, each with the words that truly answer to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thinkgrasp.sim import tabletop as t
from thinkgrasp.sim.solids import Box, Cylinder, Ellipsoid, Paint, Solid, Tube

COLORS = {
    "red": (186, 34, 36),
    "orange": (228, 120, 30),
    "yellow": (230, 200, 50),
    "green": (60, 150, 80),
    "blue": (40, 90, 190),
    "purple": (124, 60, 160),
    "white": (230, 230, 226),
    "black": (36, 36, 40),
}
BOXES = "box, cracker box, book, sponge, rubiks cube, block, stapler, phone, soap, toy car"
LABELLED = ("box", "can", "bottle", "lying bottle")
PAINTS = {"ball": ("blue", "black"), "drill": ("orange", "yellow", "red", "blue", "green")}
"""Balls have colours that no fruit of their size has, drills those of drills."""
ROUND = "ball, apple, orange, lemon, tomato, pear, peach, tennis ball, baseball"


@dataclass(frozen=True)
class Truth:
    """What a thing is called and good for."""

    names: tuple[str, ...]
    color: str = ""
    """Empty where it has several or where nobody would say it."""
    shape: str = ""
    """A word for its shape that is beyond doubt; empty where there is none."""
    category: str = ""
    uses: tuple[str, ...] = ()
    like: tuple[str, ...] = ()
    """Names that a camera may well give it: no request for an absent thing uses them."""


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(", "))


TRUTHS = {
    "box": Truth(("box",), shape="rectangular", like=_words(BOXES)),
    "block": Truth(("block",), category="toy", uses=("play with",), like=(*_words(BOXES), "computer mouse")),
    "can": Truth(("can",), shape="cylindrical", like=("can", "bottle", "mug", "cup", "glass")),
    "mug": Truth(("mug", "cup"), uses=("drink from",), like=("bowl",)),
    "cup": Truth(("cup",), uses=("drink from",), like=("mug", "bowl", "wine glass")),
    "bowl": Truth(("bowl",), uses=("eat soup from",), like=("cup", "mug", "plate")),
    "ball": Truth(("ball",), shape="round", category="toy", uses=("play with",), like=_words(ROUND)),
    "orange": Truth(("orange", "ball"), "orange", "round", "fruit", ("eat", "play with"), _words(ROUND)),
    "lemon": Truth(("lemon", "ball"), "yellow", "", "fruit", ("eat", "play with"), _words(ROUND)),
    "apple": Truth(("apple", "ball"), "red", "round", "fruit", ("eat", "play with"), _words(ROUND)),
    "banana": Truth(("banana",), "yellow", "", "fruit", ("eat",), ("carrot", "cucumber")),
    "marker": Truth(
        ("marker",), shape="elongated", uses=("write with",), like=_words("pen, pencil, screwdriver, toothbrush, knife")
    ),
    "drill": Truth(("drill",), category="tool", uses=("drill a hole",), like=("hammer", "wrench")),
    "bottle": Truth(("bottle",), like=("can", "cucumber", "carrot", "flashlight", "wine glass")),
    "lying bottle": Truth(("bottle",), like=("can", "cucumber", "carrot", "flashlight")),
    "knife": Truth(
        ("knife",), uses=("cut",), like=_words("fork, spoon, screwdriver, toothbrush, marker, wrench, scissors, pencil")
    ),
    "spoon": Truth(("spoon",), like=_words("fork, knife, screwdriver, toothbrush, wrench, scissors, hammer, marker")),
    "screwdriver": Truth(
        ("screwdriver",),
        category="tool",
        uses=("tighten a screw",),
        like=_words("marker, knife, fork, spoon, toothbrush, hammer, wrench, scissors, pencil"),
    ),
    "hammer": Truth(
        ("hammer",), category="tool", uses=("hit a nail",), like=_words("wrench, screwdriver, scissors, drill")
    ),
    "plate": Truth(("plate",), like=("bowl", "skillet lid")),
}


def random_thing(rng: np.random.Generator, x: float, y: float) -> tuple[t.TableObject, float]:
    """Return a random thing, named "colour kind" or "colour/label kind", and the radius of its footprint [m]."""
    kind = str(rng.choice(list(TRUTHS)))
    color = TRUTHS[kind].color or str(rng.choice(PAINTS.get(kind, tuple(COLORS))))
    other = str(rng.choice([c for c in COLORS if c != color]))
    T = t.pose(x, y, 0.0, rng.uniform(0, 2 * np.pi))
    thing, radius = _build(kind, Paint(COLORS[color]), Paint(COLORS[color], COLORS[other], (-0.008, 0.012)), T, rng)
    colors = f"{color}/{other}" if kind in LABELLED else color
    return replace(thing, name=f"{colors} {kind}"), radius


def truth(thing: t.TableObject) -> tuple[str, str, Truth]:
    """Return the main colour, the label's colour and the truth of a thing made by `random_thing`."""
    colors, _, kind = thing.name.partition(" ")
    color, _, label = colors.partition("/")
    return color, label, TRUTHS[kind]


def height_m(thing: t.TableObject) -> float:
    """Return how high a thing made by `random_thing` stands [m]."""
    tops = []
    for solid in thing.solids:
        low, high = solid.aabb
        corners = np.array(
            [[a, b, c, 1.0] for a in (low[0], high[0]) for b in (low[1], high[1]) for c in (low[2], high[2])]
        )
        tops.append((corners @ (thing.T_world_object @ solid.T_object_solid).T)[:, 2].max())
    return float(max(tops))


def _lying(x: float, y: float, z: float) -> t.Float:
    T = t.pose(x, y, z)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    return T


def _build(kind: str, plain: Paint, label: Paint, T: t.Float, rng: np.random.Generator) -> tuple[t.TableObject, float]:
    steel, dark = Paint((176, 178, 182)), Paint((44, 44, 48))
    if kind == "box":
        size = (rng.uniform(0.08, 0.17), rng.uniform(0.035, 0.07), rng.uniform(0.08, 0.21))
        return t.box(kind, size, label, T), float(np.hypot(*size[:2])) / 2
    if kind == "block":
        size = tuple(rng.uniform(0.03, 0.06, 3))
        return t.box(kind, size, plain, T), float(np.hypot(*size[:2])) / 2
    if kind == "can":
        r = rng.uniform(0.03, 0.04)
        return t.can(kind, r, rng.uniform(0.08, 0.13), label, T), r
    if kind == "mug":
        r = rng.uniform(0.036, 0.044)
        return t.mug(kind, r, rng.uniform(0.08, 0.11), plain, T), r + 0.03
    if kind == "cup":
        r = rng.uniform(0.027, 0.038)
        return t.cup(kind, r, rng.uniform(0.07, 0.11), plain, T), 1.2 * r
    if kind == "bowl":
        r = rng.uniform(0.07, 0.09)
        return t.bowl(kind, r, 0.055, plain, T), r
    if kind in ("ball", "orange", "apple"):
        r = rng.uniform(0.033, 0.042)
        return t.ball(kind, r, plain, T), r
    if kind == "banana":
        return t.banana(kind, T), 0.09
    if kind == "marker":
        return t.marker(kind, plain, T), 0.062
    if kind == "drill":
        return t.drill(kind, T, Paint(plain.color)), 0.1
    if kind == "lying bottle":
        r, length = rng.uniform(0.025, 0.035), rng.uniform(0.14, 0.19)
        neck = Cylinder(0.4 * r, 0.03, label, _lying(length / 2 + 0.014, 0, r))
        return t.TableObject(kind, (Cylinder(r, length, label, _lying(0, 0, r)), neck), T), 0.11
    return _flat_or_mixed(kind, plain, label, steel, dark, T, rng)


def _flat_or_mixed(
    kind: str, plain: Paint, label: Paint, steel: Paint, dark: Paint, T: t.Float, rng: np.random.Generator
) -> tuple[t.TableObject, float]:
    parts: tuple[Solid, ...]
    if kind == "lemon":
        body = Ellipsoid((0.042, 0.029, 0.029), plain, t.pose(0, 0, 0.029))
        return t.TableObject(kind, (body,), T), 0.042
    if kind == "bottle":
        r, h = rng.uniform(0.028, 0.036), rng.uniform(0.11, 0.15)
        shoulder = Cylinder(r, 0.03, label, t.pose(0, 0, h + 0.015), top_radius_m=0.4 * r)
        neck = Cylinder(0.4 * r, 0.03, dark, t.pose(0, 0, h + 0.045))
        return t.TableObject(kind, (Cylinder(r, h, label, t.pose(0, 0, h / 2)), shoulder, neck), T), r
    if kind == "knife":
        parts = (
            Box((0.12, 0.022, 0.003), steel, t.pose(0.06, 0, 0.010)),
            Box((0.10, 0.02, 0.016), dark, t.pose(-0.05, 0, 0.008)),
        )
        return t.TableObject(kind, parts, T), 0.11
    if kind == "spoon":
        path = np.stack([np.linspace(-0.11, 0.04, 9), np.zeros(9), 0.006 + 0.006 * np.linspace(1, 0, 9)], axis=1)
        parts = (Tube(path, (0.005,) * 9, steel), Ellipsoid((0.03, 0.02, 0.008), steel, t.pose(0.06, 0, 0.008)))
        return t.TableObject(kind, parts, T), 0.1
    if kind == "screwdriver":
        handle = Cylinder(0.015, 0.10, plain, _lying(-0.05, 0, 0.015))
        return t.TableObject(kind, (handle, Cylinder(0.004, 0.10, steel, _lying(0.05, 0, 0.015))), T), 0.1
    if kind == "hammer":
        handle = Cylinder(0.013, 0.24, Paint((150, 104, 60)), _lying(-0.03, 0, 0.016))
        return t.TableObject(kind, (handle, Box((0.032, 0.10, 0.032), dark, t.pose(0.10, 0, 0.016))), T), 0.14
    r = rng.uniform(0.095, 0.12)
    parts = (Cylinder(0.7 * r, 0.016, plain, t.pose(0, 0, 0.008), top_radius_m=r),)
    return t.TableObject(kind, parts, T), r
