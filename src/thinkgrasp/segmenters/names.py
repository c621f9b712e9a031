"""What else a thing may be asked for by, and what a part belongs to: pure text."""

from __future__ import annotations

import re
from collections.abc import Iterable

from thinkgrasp.language.query import parse
from thinkgrasp.types import PlannedObject

_AFTER_HEAD = frozenset(
    [
        *("of", "with", "without", "on", "in", "into", "inside", "at", "by", "from", "for", "to", "under", "behind"),
        *("beside", "between", "next", "near", "and", "or", "that", "which"),
    ]
)
_BEFORE_HEAD = frozenset(("a", "an", "the", "my", "your", "this", "that", "some"))


def head_noun(name: str) -> str | None:
    """Return the word that says what kind of thing a name means, "box" of "red cracker box"; None where that is all.

    It is the last word before "of", "with", "on" and the like.
    """
    words = name.split()
    start = 1 if words and words[0].lower() in _BEFORE_HEAD else 0
    end = next((i for i, word in enumerate(words) if i > start and word.lower() in _AFTER_HEAD), len(words))
    head = words[end - 1].strip(".,;:!?") if words[start:end] else ""
    return head if head and (end - start > 1 or end < len(words)) else None


def whole_and_part(target: str) -> tuple[str, str | None]:
    """Return what a part belongs to and the part: "red mug" and "handle" of "red mug handle" or "red mug: handle".

    The part is None where nothing but one word is said, which is then taken for the whole.
    """
    whole, colon, part = (text.strip() for text in target.partition(":"))
    if colon and whole and part:
        return whole, part
    query = parse(target)
    if len(query.wanted) == 1 and query.wanted[0].part and query.wanted[0].has_noun:
        return query.wanted[0].label, query.wanted[0].part
    words = re.sub(r"[:\s]+", " ", target).strip().split(" ")
    return (" ".join(words[:-1]), words[-1]) if len(words) > 1 else (words[0], None)


def other_names(target: str, objects: Iterable[PlannedObject], most: int) -> tuple[str, ...]:
    """Return what to ask for where a name is not found: its head noun, then the best of what else was considered."""
    names = [head_noun(target) or ""]
    ranked = sorted(objects, key=lambda o: -o.grasp_score)
    others = [o.name for o in ranked if o.name.strip().lower() not in (target.strip().lower(), names[0].lower())]
    names += list(dict.fromkeys(others))[:most]
    return tuple(name for name in names if name.strip())
