"""Phrases as a caption, and which tokens of it are whose: pure text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from thinkgrasp.types import Degradation

_SEPARATORS = re.compile(r"[.?\s]+")
"""What parts phrases for GroundingDINO; inside a phrase it would cut it in two."""
_SHOWN = 60


@dataclass(frozen=True)
class Caption:
    """Phrases in one text, "a mug. a red box.", and where each stands in it."""

    text: str
    spans: tuple[tuple[int, int], ...]
    """Half-open character range of each phrase."""

    @classmethod
    def of(cls, phrases: Sequence[str]) -> Caption:
        """Join phrases; each in lower case, without full stops and question marks."""
        text, spans = "", []
        for phrase in map(clean, phrases):
            text += " " if text else ""
            spans.append((len(text), len(text) + len(phrase)))
            text += f"{phrase}."
        return cls(text, tuple(spans))

    def tokens(self, offsets: Sequence[tuple[int, int]]) -> tuple[tuple[int, ...], ...]:
        """Return for each phrase the indices of its tokens.

        Args:
            offsets: Half-open character range of each token; (0, 0) for tokens that stand for no text.
        """
        return tuple(
            tuple(i for i, (start, end) in enumerate(offsets) if end > start and start < last and end > first)
            for first, last in self.spans
        )


def unread(text: str, offsets: Sequence[tuple[int, int]]) -> str:
    """Return the end of a text that its tokens do not cover, shortened; empty where all but a full stop is covered.

    Args:
        text: What was cut at a network's limit.
        offsets: As in `Caption.tokens`.
    """
    rest = text[max((end for _, end in offsets), default=0) :].strip(" .")
    return rest if len(rest) <= _SHOWN else f"{rest[:_SHOWN]}..."


class Reader(Protocol):
    """A network that reads text up to a limit."""

    @property
    def text_limit(self) -> int:
        """So many tokens."""
        ...

    def unread(self, phrase: str) -> str:
        """Return the end of a phrase that is beyond it."""
        ...


def cut_short(network: Reader, phrase: str) -> tuple[Degradation, ...]:
    """Return what has to be said of a phrase that a network does not read to its end: nothing, or one line."""
    rest = network.unread(phrase)
    if not rest:
        return ()
    reason = f"the text is longer than the {network.text_limit} tokens that are read; not read: {rest!r}"
    return (Degradation("segment", reason, "the text before that"),)


def clean(phrase: str) -> str:
    """Return a phrase in lower case, on one line, without what parts phrases."""
    return _SEPARATORS.sub(" ", phrase.lower()).strip()
