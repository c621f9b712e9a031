"""What can be asked for: one thing with its attributes, places and relations, or several."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ColorWish:
    """A colour that was asked for, with its tone: "", "dark" or "light"."""

    word: str
    tone: str = ""


@dataclass(frozen=True)
class Superlative:
    """The most extreme thing by a key (biggest, leftmost, nearest, ...); rank 2 = the second."""

    key: str
    rank: int = 1


@dataclass(frozen=True)
class RelationWish:
    """A place relative to other things: next to, behind, in front of, on, under, in, left of, right of, between."""

    kind: str
    landmarks: tuple[Wanted, ...]


@dataclass(frozen=True)
class Wanted:
    """One thing that was asked for; empty fields were not said."""

    names: tuple[str, ...] = ()
    """Known object names, alternatives to each other."""
    categories: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    colors: tuple[ColorWish, ...] = ()
    any_color: bool = False
    """The colours are alternatives ("red or blue") rather than all wanted ("red and white")."""
    shapes: tuple[str, ...] = ()
    sizes: tuple[str, ...] = ()
    """Of small, big, tall, short."""
    superlative: Superlative | None = None
    views: tuple[str, ...] = ()
    """Of left, right, middle, front, back of the view."""
    relations: tuple[RelationWish, ...] = ()
    part: str | None = None
    """The word for the part to take it by."""
    anything: bool = False
    """Any object will do."""
    said: str = ""
    """The noun as it was said, for labels."""

    @property
    def has_noun(self) -> bool:
        """Whether it says what kind of thing is wanted."""
        return bool(self.names or self.categories or self.uses)

    @property
    def understood(self) -> bool:
        """Whether anything was said that can tell one thing from another."""
        return self.has_noun or self.anything or self.has_attributes

    @property
    def has_attributes(self) -> bool:
        """Whether a colour, shape, size, place or relation was said."""
        return bool(self.colors or self.shapes or self.sizes or self.superlative or self.views or self.relations)

    @property
    def label_colors(self) -> str:
        """The colours as words."""
        return (" or " if self.any_color else " and ").join(f"{c.tone} {c.word}".strip() for c in self.colors)

    @property
    def label(self) -> str:
        """A short readable name such as "small red box"."""
        words = [self.superlative.key] if self.superlative else []
        words += [*self.sizes, *self.shapes, self.label_colors]
        noun = self.said or (f"thing to {self.uses[0]}" if self.uses else "object")
        return " ".join(w for w in (*words, noun) if w)


@dataclass(frozen=True)
class Query:
    """An instruction, understood as far as possible."""

    text: str
    wanted: tuple[Wanted, ...]
    """Alternatives, the first said comes first."""
    excluded: tuple[Wanted, ...] = ()
    """What must not be taken ("not the red one")."""
    unknown: tuple[str, ...] = ()
    """Words that were not understood."""

    @property
    def understood(self) -> bool:
        """Whether there is anything to look for."""
        return bool(self.wanted)

    @property
    def label(self) -> str:
        """A short readable name of all that is wanted."""
        return " or ".join(dict.fromkeys(w.label for w in self.wanted)) or "object"
