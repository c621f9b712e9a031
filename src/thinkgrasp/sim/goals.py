"""The referee's rule: which objects truly serve an instruction, by what they are and never by how they look in a view.

A person's words are parsed as the pipeline parses them; an object answers by its name, category, uses and colours and
by the household knowledge of its kind. Sizes, superlatives and places choose among answers and are not judged here.
"""

from __future__ import annotations

from collections.abc import Sequence

from thinkgrasp.language.knowledge import load_knowledge
from thinkgrasp.language.query import parse
from thinkgrasp.language.vocabulary import load_vocabulary, read, tokenise
from thinkgrasp.language.wanted import Wanted
from thinkgrasp.sim.description import known_kind
from thinkgrasp.sim.objects import SimObject

SERVES, SERVES_IF_NEED_BE, SERVES_NOT = 0, 1, 2
_NOT_ROUND = frozenset({"elongated", "flat"})
"""What may show one of these is not called a round object: a pear, a bagel."""


def goals_in(instruction: str, objects: Sequence[SimObject]) -> tuple[int, ...]:
    """Return the indices of the objects that serve an instruction.

    What serves a use only as a second choice (a box to hold things, beside a bowl) counts where nothing serves it
    properly. What the instruction excludes never counts.
    """
    query = parse(instruction)
    left = [(i, obj) for i, obj in enumerate(objects) if all(_rank(w, obj) == SERVES_NOT for w in query.excluded)]
    said = _words(instruction)
    if literal := [i for i, obj in left if _is_own_name(obj.name) and _holds(said, _words(obj.name))]:
        return tuple(literal)
    return tuple(sorted(set().union(*(_best(wanted, left) for wanted in query.wanted))))


def _is_own_name(name: str) -> bool:
    """Whether a name is none of the knowledge's: who says it ("the thera med", "my gizmo") means nothing else.

    A colour before a name ("red cup") describes, and another red cup answers as well.
    """
    colored = any(lexeme.has("color") for sentence in read(name) for lexeme in sentence)
    return name not in load_knowledge().objects and not colored


def _words(text: str) -> list[str]:
    return [word for sentence in tokenise(text) for word in sentence]


def _holds(words: list[str], part: list[str]) -> bool:
    n = len(part)
    return n > 0 and any(words[i : i + n] == part for i in range(len(words) - n + 1))


def _best(wanted: Wanted, objects: Sequence[tuple[int, SimObject]]) -> set[int]:
    ranks = {i: _rank(wanted, obj) for i, obj in objects}
    best = min(ranks.values(), default=SERVES_NOT)
    return {i for i, rank in ranks.items() if rank == best != SERVES_NOT}


def _rank(wanted: Wanted, obj: SimObject) -> int:
    if not _has_attributes(wanted, obj):
        return SERVES_NOT
    if wanted.names:
        kind = known_kind(obj.name)
        kinds = frozenset().union(*(load_knowledge().kinds_of(name) for name in wanted.names))
        return SERVES if kind is not None and kind.name in kinds else SERVES_NOT
    if wanted.categories and not _categories(obj) & set(wanted.categories):
        return SERVES_NOT
    if wanted.uses:
        kind = known_kind(obj.name)
        if set(wanted.uses) & set(obj.uses):
            return SERVES
        return SERVES_IF_NEED_BE if kind is not None and set(wanted.uses) & set(kind.second_uses) else SERVES_NOT
    return SERVES if wanted.understood else SERVES_NOT


def _categories(obj: SimObject) -> set[str]:
    kind = known_kind(obj.name)
    return {obj.category, *(kind.categories if kind is not None else ())}


def _has_attributes(wanted: Wanted, obj: SimObject) -> bool:
    names = load_vocabulary().colors
    has = [any(name in obj.colors for name in names[wish.word]) for wish in wanted.colors]
    colored = not has or (any(has) if wanted.any_color else all(has))
    return colored and all(_has_shape(shape, obj) for shape in wanted.shapes)


def _has_shape(shape: str, obj: SimObject) -> bool:
    kind = known_kind(obj.name)
    if kind is None:
        return False
    if shape == "round":
        return "round" in kind.shapes and not _NOT_ROUND & {*kind.shapes, *kind.optional_shapes}
    return shape in (*kind.shapes, *kind.either_shapes)
