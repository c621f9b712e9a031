"""Toys that are not animals, and the small backpack."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from thinkgrasp.sim.catalogue import printing
from thinkgrasp.sim.catalogue.entry import Build, Entry, Part, Parts
from thinkgrasp.sim.catalogue.palette import (
    BLACK,
    BLUE,
    CREAM,
    DARK_RED,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TAN,
    WHITE,
    YELLOW,
)
from thinkgrasp.sim.catalogue.printing import RGB
from thinkgrasp.sim.catalogue.solid import Solid, ball, box, egg, prism, rod, taper, total, tube, turned, vessel


def _rubiks_cube(rng: Generator) -> Parts:
    side, lift = 56.0, 0.3
    half = side / 2
    top, front = box(54, 54, 1).at(z=half + lift - 1), box(54, 1, 54).at(y=half + lift - 0.5, z=-27)
    faces: tuple[tuple[Solid, RGB], ...] = (
        (top, WHITE),
        (top.turn("x", 180), YELLOW),
        (front, GREEN),
        (front.turn("z", 180), BLUE),
        (front.turn("z", 90), ORANGE),
        (front.turn("z", -90), RED),
    )
    core = Part("body", box(side, side, side, 1.5).at(z=-half), BLACK)
    return (core, *(Part("face", s.ghost(), c, printing.squares(c, BLACK)) for s, c in faces))


def _block(x: float, y: float, z: float, color: RGB, edge: float = 1.0) -> Build:
    return lambda rng: (Part("body", box(x, y, z, edge), color, gloss=0.1),)


def _lego(rng: Generator) -> Parts:
    studs = total([rod(6, 6, 10).at(x=x, y=y, z=28) for x in (-24, -8, 8, 24) for y in (-8, 8)])
    return (Part("body", box(64, 32, 28), RED, gloss=0.4), Part("stud", studs, RED, gloss=0.4))


def _dice(rng: Generator) -> Parts:
    pips = [rod(3.6, 0.6, 10).at(x=x, y=y, z=35.6) for x, y in ((-10, -10), (-10, 10), (0, 0), (10, -10), (10, 10))]
    return (Part("body", box(36, 36, 36, 2), WHITE, gloss=0.4), Part("pip", total(pips).ghost(), BLACK))


def _airplane(body: RGB, wing: RGB) -> Build:
    def build(rng: Generator) -> Parts:
        wings = prism([(-22, -75), (0, -75), (22, 0), (0, 75), (-22, 75)], 9).at(x=8, z=12)
        fin = prism([(-14, 0), (12, 0), (-4, 32), (-16, 32)], 7).turn("x", 90).at(x=-62, y=3.5, z=28)
        tail = prism([(-12, -30), (4, -30), (12, 0), (4, 30), (-12, 30)], 7).at(x=-62, z=18)
        return (
            Part("body", taper(20, 12, 105).turn("y", -90).at(x=45, z=20), body, gloss=0.4),
            Part("wing", wings, wing, gloss=0.4),
            Part("tail", fin + tail, wing, gloss=0.4),
            Part("nose", rod(7, 14, 12).turn("y", 90).at(x=62, z=20), BLACK),
        )

    return build


def _helicopter(rng: Generator) -> Parts:
    return (
        Part("body", egg(38, 25, 25).at(z=32), GREEN, gloss=0.4),
        Part("tail", tube([(-30, 0, 38), (-85, 0, 44)], [9, 6]), GREEN),
        Part("rotor", rod(5, 16, 10).at(z=54) + box(124, 14, 4).at(z=68), GREY),
        Part("skid", total([tube([(-30, y, 6), (30, y, 6)], 4) for y in (-18, 18)]), GREY),
        Part("strut", total([tube([(0, y, 6), (0, 0.7 * y, 18)], 4) for y in (-18, 18)]), GREY),
    )


def _rocket(rng: Generator) -> Parts:
    fin = prism([(18, 0), (38, 0), (38, 14), (18, 42)], 6).turn("x", 90).at(y=3)
    return (
        Part("body", turned([(18, 6), (22, 40), (20, 90)]), WHITE, gloss=0.4),
        Part("nose", turned([(20, 90), (13, 115), (3, 132)]), RED, gloss=0.4),
        Part("fin", total([fin.turn("z", a) for a in (0, 120, 240)]), RED),
    )


def _plastic_bolt(rng: Generator) -> Parts:
    thread = turned([(13, 0), (15, 4), (15, 50)])
    head = prism(24 * np.column_stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)]), 20)
    return (Part("thread", thread, YELLOW), Part("head", head.at(z=50), RED))


def _pawn(rng: Generator) -> Parts:
    return (
        Part("base", turned([(21, 0), (21, 10), (14, 16)]), CREAM, gloss=0.5),
        Part("body", turned([(13, 16), (8, 52), (13, 56), (13, 60)]), CREAM, gloss=0.5),
        Part("head", ball(15).at(z=70), CREAM, gloss=0.5),
    )


def _car(rng: Generator) -> Parts:
    wheels = total([rod(13, 12, 14).turn("x", 90 * s).at(x=x, y=16 * s * -1, z=13) for x in (-32, 32) for s in (-1, 1)])
    cabin = prism([(-30, 0), (24, 0), (12, 22), (-22, 22)], 42).turn("x", 90).at(y=21, z=37)
    return (
        Part("body", box(112, 48, 26, 4).at(z=12), RED, gloss=0.5),
        Part("cabin", cabin, SKY, gloss=0.8),
        Part("wheel", wheels, BLACK),
    )


def _stacking_cup(rng: Generator) -> Parts:
    profile = [(25, 0), (31, 64)]
    return (Part("body", vessel(profile, 3.5), PURPLE, gloss=0.3),)


def _backpack(rng: Generator) -> Parts:
    straps = total([tube([(-30, y, 84), (-44, y, 66), (-44, y, 26), (-30, y, 10)], 4.5) for y in (-20, 20)])
    loop = tube([(-12, -14, 94), (-12, -9, 108), (-12, 9, 108), (-12, 14, 94)], 4)
    return (
        Part("body", box(58, 78, 98, 10), RED, gloss=0.1),
        Part("pocket", box(20, 58, 44, 4).at(x=34, z=8), DARK_RED, gloss=0.1),
        Part("strap", straps + loop, BLACK),
    )


ENTRIES = (
    Entry("rubiks cube", "toy", ("white", "red", "blue"), 0.1, 0.6, _rubiks_cube),
    Entry("wood block", "toy", ("brown",), 0.12, 0.65, _block(95, 44, 44, TAN)),
    Entry("blue block", "toy", ("blue",), 0.06, 0.65, _block(46, 46, 46, BLUE)),
    Entry("lego brick", "toy", ("red",), 0.05, 0.6, _lego),
    Entry("dice", "toy", ("white",), 0.05, 0.6, _dice),
    Entry("toy airplane", "toy", ("red", "yellow"), 0.12, 0.6, _airplane(YELLOW, RED)),
    Entry("blue toy airplane", "toy", ("blue", "white"), 0.12, 0.6, _airplane(WHITE, BLUE)),
    Entry("helicopter", "toy", ("green", "grey"), 0.1, 0.6, _helicopter),
    Entry("rocket", "toy", ("white", "red"), 0.08, 0.6, _rocket),
    Entry("toy car", "toy", ("red", "black"), 0.12, 0.6, _car),
    Entry("plastic bolt", "toy", ("red", "yellow"), 0.05, 0.6, _plastic_bolt),
    Entry("stacking cup", "toy", ("purple",), 0.04, 0.6, _stacking_cup),
    Entry("pawn", "toy", ("white",), 0.06, 0.6, _pawn),
    Entry("red backpack", "container", ("red", "black"), 0.1, 0.75, _backpack),
)
