"""Phrases as a caption, and which tokens of it are whose: pure text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_SEPARATORS = re.compile(r"[.?\s]+")
"""What parts phrases for GroundingDINO; inside a phrase it would cut it in two."""


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


def clean(phrase: str) -> str:
    """Return a phrase in lower case, on one line, without what parts phrases."""
    return _SEPARATORS.sub(" ", phrase.lower()).strip()
