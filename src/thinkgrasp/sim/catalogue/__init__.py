"""Household objects made by code: every shape, mass and print follows from a name and a seed.

Each family of things has a module with a table of `Entry` rows; what a row builds is put together from the solids of
`solid`, whose visual and collision shapes come from the same numbers.
"""

from __future__ import annotations

import difflib
from functools import cache
from typing import Literal

from thinkgrasp.errors import ConfigError
from thinkgrasp.sim.catalogue import (
    animals,
    balls,
    bottles,
    food,
    fruit,
    hygiene,
    kitchen,
    machine,
    office,
    tools,
    toys,
    vessels,
)
from thinkgrasp.sim.catalogue.entry import Entry
from thinkgrasp.sim.objects import SimObject

__all__ = ["categories", "make", "names", "split"]

_FAMILIES = (fruit, food, bottles, vessels, kitchen, tools, machine, office, hygiene, toys, animals, balls)
_UNSEEN_NAMES = """
    battery, black marker, bleach cleanser, blue ball, blue moon, eggplant, gelatin box, hammer, kiwi, lime,
    magic clean, mango, milk carton, mustard bottle, pink tea box, red backpack, red marker, remote control, repellent,
    rubiks cube, shampoo bottle, small clamp, soap dish, softball, sponge, spoon, stapler, sugar box, tennis ball,
    tuna can, two color hammer, white ball, white sugar box, yellow bowl, yellow cup
"""
_UNSEEN = frozenset(name.strip() for name in _UNSEEN_NAMES.split(","))


@cache
def _entries() -> dict[str, Entry]:
    return {entry.name: entry for family in _FAMILIES for entry in family.ENTRIES}


def names() -> tuple[str, ...]:
    """Return the names of all objects."""
    return tuple(_entries())


def split(which: Literal["seen", "unseen"]) -> tuple[str, ...]:
    """Return the names for ordinary clutter ("seen") or for the heavy suite ("unseen"); no name is in both.

    Raises:
        ConfigError: Neither "seen" nor "unseen" was asked for.
    """
    if which not in ("seen", "unseen"):
        raise ConfigError(f"no split {which!r} of the catalogue; allowed are 'seen' and 'unseen'")
    return tuple(name for name in names() if (name in _UNSEEN) == (which == "unseen"))


def categories() -> tuple[str, ...]:
    """Return the categories of all objects, sorted."""
    return tuple(sorted({entry.category for entry in _entries().values()}))


def make(name: str, seed: int = 0) -> SimObject:
    """Build an object; the seed varies its size, shade and print, and the same seed gives the same bits.

    Raises:
        ConfigError: No object of that name; the message says which is close.
    """
    entries = _entries()
    if name not in entries:
        close = difflib.get_close_matches(name, entries, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ConfigError(f"no catalogue object {name!r}; {hint}{len(entries)} names are listed by catalogue.names()")
    return entries[name].make(seed)
