"""What is known of household objects: colours, shapes, sizes, uses, and where to take them."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from typing import Any

from thinkgrasp.errors import ConfigError
from thinkgrasp.language import COLOR_NAMES, SHAPE_NAMES

PLACES = ("wide", "thin", "protrusion", "rim", "top", "bottom", "middle")
"""Where a part is found on a thing: which end of a long thing, or which feature of its outline."""

COMMONNESS = {"everywhere": 1.0, "usual": 0.85, "seldom": 0.65}
_MIDDLE_OF_ROUND = 1.3
"""What is round across has a middle side not much longer than its shortest."""


@dataclass(frozen=True)
class Part:
    """A part of an object and where to look for it."""

    name: str
    place: str


@dataclass(frozen=True)
class KnownObject:
    """One kind of household object."""

    name: str
    synonyms: tuple[str, ...]
    categories: tuple[str, ...]
    colors: tuple[str, ...]
    """Usual colours; empty = any."""
    shapes: tuple[str, ...]
    """Descriptors that it shows from most sides."""
    either_shapes: tuple[str, ...]
    """Descriptors of which it shows at least one; empty = no such choice."""
    optional_shapes: tuple[str, ...]
    """Descriptors that it may show."""
    longest_m: tuple[float, float]
    shortest_m: tuple[float, float]
    middle_m: tuple[float, float]
    rise: tuple[float, float]
    """Height over the middle side of an open vessel that stands; (0, inf) for other things."""
    lies: bool
    """Whether it does not stand on its end."""
    common: float
    """How usual it is on a table before a robot: 1 for what is found everywhere, less for what seldom is."""
    uses: tuple[str, ...]
    second_uses: tuple[str, ...]
    """Uses that it serves, though other things serve them better."""
    take: tuple[Part, ...]
    avoid: tuple[Part, ...]

    def part(self, name: str) -> Part | None:
        """Return the part of this name, to take or to avoid, or None."""
        return next((p for p in (*self.take, *self.avoid) if p.name == name), None)


@dataclass(frozen=True)
class Knowledge:
    """All known objects by name."""

    objects: Mapping[str, KnownObject]

    @cached_property
    def categories(self) -> frozenset[str]:
        """Every category that some object has."""
        return frozenset(c for o in self.objects.values() for c in o.categories)

    @cached_property
    def uses(self) -> frozenset[str]:
        """Every use that some object serves."""
        return frozenset(u for o in self.objects.values() for u in (*o.uses, *o.second_uses))

    def kinds_of(self, name: str) -> frozenset[str]:
        """Return the names that are this object or a kind of it: a "soup can" is a "can", a "softball" a "ball"."""
        return frozenset(
            o.name
            for o in self.objects.values()
            if o.name == name or name in o.categories or o.name.endswith(f" {name}")
        )


def load_knowledge() -> Knowledge:
    """Return the household knowledge that ships with the package; read once.

    Raises:
        ConfigError: The data file breaks its own rules.
    """
    return _load()


@lru_cache(maxsize=1)
def _load() -> Knowledge:
    text = resources.files("thinkgrasp.language").joinpath("knowledge.toml").read_text(encoding="utf-8")
    return parse_knowledge(tomllib.loads(text))


def parse_knowledge(groups: Mapping[str, Mapping[str, Any]]) -> Knowledge:
    """Turn the groups of the data file into objects.

    Raises:
        ConfigError: A row has the wrong form, an unknown colour, shape or place, a size range that is not ordered, or a
            name that occurs twice.
    """
    objects: dict[str, KnownObject] = {}
    commonness = {name: COMMONNESS[how] for how, names in groups.get("commonness", {}).items() for name in names}
    for group_name, group in groups.items():
        if group_name == "commonness":
            continue
        shared = {k: v for k, v in group.items() if k != "rows"}
        for row in group["rows"]:
            obj = _parse_row(group_name, shared, row, commonness)
            if obj.name in objects:
                raise ConfigError(f"household knowledge: {obj.name!r} occurs twice")
            objects[obj.name] = obj
    if unknown := sorted(commonness.keys() - objects.keys()):
        raise ConfigError(f"household knowledge: commonness names unknown objects: {', '.join(unknown)}")
    return Knowledge(objects)


def _parse_row(group: str, shared: Mapping[str, Any], row: list[Any], commonness: Mapping[str, float]) -> KnownObject:
    if len(row) not in (6, 7):
        raise ConfigError(f"household knowledge, group {group!r}: a row has 6 or 7 entries, got {row}")
    name, synonyms, colors, shapes, longest, shortest = row[:6]
    own = {**shared, **(row[6] if len(row) == 7 else {})}
    where = f"household knowledge, {name!r}"
    uses = own.get("uses", [])
    ranges = [_metres(where, r) for r in (longest, shortest)]
    if ranges[1][0] > ranges[0][0] or ranges[1][1] > ranges[0][1]:
        raise ConfigError(f"{where}: the shortest side {shortest} exceeds the longest {longest}")
    shapes_said = [s for s in shapes.split() if s[-1] != "?"]
    middle = (ranges[1][0], _MIDDLE_OF_ROUND * ranges[1][1] if "cylindrical" in shapes_said else ranges[0][1])
    return KnownObject(
        name=name,
        synonyms=tuple(s.strip() for s in synonyms.split(",") if s.strip()),
        categories=tuple(own.get("categories", ())),
        colors=_known(where, "colour", (c.rstrip("?") for c in colors.split()), COLOR_NAMES),
        shapes=_known(where, "shape", (s for s in shapes.split() if s[-1] != "?" and "/" not in s), SHAPE_NAMES),
        either_shapes=_known(
            where, "shape", (e for s in shapes.split() if "/" in s for e in s.split("/")), SHAPE_NAMES
        ),
        optional_shapes=_known(where, "shape", (s[:-1] for s in shapes.split() if s.endswith("?")), SHAPE_NAMES),
        longest_m=ranges[0],
        shortest_m=ranges[1],
        middle_m=_metres(where, own["middle"]) if "middle" in own else middle,
        rise=_range(where, own["rise"]) if "rise" in own else (0.0, float("inf")),
        lies=bool(own.get("lies", False)),
        common=commonness.get(name, COMMONNESS["usual"]),
        uses=tuple(u for u in uses if not u.endswith("?")),
        second_uses=tuple(u[:-1] for u in uses if u.endswith("?")),
        take=tuple(_part(where, p) for p in own.get("take", ())),
        avoid=tuple(_part(where, p) for p in own.get("avoid", ())),
    )


def _metres(where: str, range_mm: list[float]) -> tuple[float, float]:
    low, high = range_mm
    if not 0 <= low <= high <= 2000:
        raise ConfigError(f"{where}: a size range must be ordered and within 0..2000 mm, got {range_mm}")
    return low / 1000, high / 1000


def _range(where: str, ratio: list[float]) -> tuple[float, float]:
    low, high = ratio
    if not 0 <= low <= high:
        raise ConfigError(f"{where}: a rise must be ordered and not negative, got {ratio}")
    return low, high


def _known(where: str, what: str, words: Iterable[str], allowed: tuple[str, ...]) -> tuple[str, ...]:
    words = tuple(words)
    for word in words:
        if word not in allowed:
            raise ConfigError(f"{where}: unknown {what} {word!r}; allowed are {', '.join(allowed)}")
    return words


def _part(where: str, text: str) -> Part:
    name, _, place = text.partition("@")
    if place not in PLACES:
        raise ConfigError(f"{where}: part {text!r} must be name@place with a place of {', '.join(PLACES)}")
    return Part(name, place)
