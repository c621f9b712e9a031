"""From a sentence to what it asks for: names, categories, uses, attributes, places, relations and parts.

Parsing is by rules over known words; nothing is learned and nothing in the text is ever executed. What no rule
understands is kept in `Query.unknown`, so that a planner can say so.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar

from thinkgrasp.language.knowledge import load_knowledge
from thinkgrasp.language.vocabulary import Lexeme, load_vocabulary, read, stem
from thinkgrasp.language.wanted import ColorWish, Query, RelationWish, Superlative, Wanted

T = TypeVar("T")

MAX_LANDMARK_DEPTH = 2
MAX_RELATIONS = 16
"""Of one sentence; further ones are not understood. The time to read a sentence grows with their number's cube."""

_USE_MARKERS = frozenset(
    {"to", "can", "for", "could", "i", "me", "we", "must", "should", "will", "wanna", "gonna", "let", "and", "then"}
)
_NOUN_USES = frozenset({"drink"})
_STATES = frozenset(["thirsty", "hungry", "starving", "headache", "sick", "ill", "thirst", "hunger", "edible"])
_INSTRUMENT_MARKERS = frozenset({"with", "using", "use"})
_VIEW_OF_RELATION = {"left of": "left", "right of": "right", "in front of": "front", "behind": "back"}
_PRONOUNS = frozenset(["i", "you", "we", "it", "that", "which", "they", "one", "someone", "robot"])
_PART_MARKERS = frozenset({"by", "at", "from"})


def parse(text: str) -> Query:
    """Parse an instruction; never raises, whatever the text.

    Args:
        text: What a person said, in English.

    Returns:
        The query. `understood` is False when no word says what to take.
    """
    wanted: list[Wanted] = []
    excluded: list[Wanted] = []
    unknown: list[str] = []
    asked = False
    for sentence in read(text):
        lexemes = _with_few_relations(_without_modal_can(sentence))
        unknown += [lexeme.text for lexeme in lexemes if _is_unknown(lexeme)]
        for chunk in _chunks(lexemes):
            thing = _Parser(chunk.lexemes).parse()
            if not thing.understood:
                continue
            if chunk.asks and thing.has_noun and not asked:
                wanted, asked = [], True
            (excluded if chunk.negated else wanted).append(thing)
    nouns = [w for w in wanted if w.has_noun]
    if nouns:
        wanted = [_merge_anaphora(wanted, w) for w in nouns]
    if not wanted and excluded and any(x.has("standin", "anything") for s in read(text) for x in s):
        wanted = [Wanted(anything=True)]
    return Query(text, tuple(dict.fromkeys(wanted)), tuple(dict.fromkeys(excluded)), tuple(dict.fromkeys(unknown)))


def _without_modal_can(lexemes: list[Lexeme]) -> list[Lexeme]:
    """Read "can" as the verb where a pronoun stands beside it ("I can write with", "can you give me")."""
    read_again: list[Lexeme] = []
    for i, lexeme in enumerate(lexemes):
        if lexeme.words == ("can",):
            before = lexemes[i - 1].text if i else ""
            after = lexemes[i + 1].words[0] if i + 1 < len(lexemes) else ""
            if before in _PRONOUNS - {"one"} or after in _PRONOUNS - {"that", "which", "robot"}:
                lexeme = Lexeme(lexeme.words, {"noise": "can"})
        read_again.append(lexeme)
    return read_again


def _with_few_relations(lexemes: list[Lexeme]) -> list[Lexeme]:
    """Take every relation after the first MAX_RELATIONS for an unknown word."""
    relations = [i for i, lexeme in enumerate(lexemes) if lexeme.has("relation")]
    beyond = set(relations[MAX_RELATIONS:])
    return [Lexeme(lexeme.words, {}) if i in beyond else lexeme for i, lexeme in enumerate(lexemes)]


def _is_unknown(lexeme: Lexeme) -> bool:
    return not lexeme.senses and not lexeme.text.isdigit()


def _merge_anaphora(wanted: list[Wanted], noun: Wanted) -> Wanted:
    """Give "I want the cup. The red one." its colour: attributes said alone belong to the only noun."""
    loose = [w for w in wanted if not w.has_noun and w.has_attributes]
    if len([w for w in wanted if w.has_noun]) != 1 or len(loose) != 1:
        return noun
    extra = loose[0]
    return replace(
        noun,
        colors=noun.colors or extra.colors,
        any_color=noun.any_color or extra.any_color,
        shapes=noun.shapes or extra.shapes,
        sizes=noun.sizes or extra.sizes,
        superlative=noun.superlative or extra.superlative,
        views=noun.views or extra.views,
        relations=noun.relations or extra.relations,
    )


@dataclass
class _Chunk:
    """A stretch of a sentence that says one thing."""

    lexemes: list[Lexeme]
    negated: bool

    @property
    def asks(self) -> bool:
        return not self.negated and any(x.has("request") for x in self.lexemes)


def _chunks(lexemes: list[Lexeme]) -> list[_Chunk]:
    """Cut at negations, and at and/or/commas where both sides have a noun of their own."""
    chunks = [_Chunk([], negated=False)]
    for i, lexeme in enumerate(lexemes):
        current = chunks[-1]
        if lexeme.has("negation"):
            chunks.append(_Chunk([], negated=True))
        elif lexeme.has("clause") and _splits(current.lexemes, lexemes[i + 1 :], current.negated):
            chunks.append(_Chunk([], negated=False))
        else:
            current.lexemes.append(lexeme)
    return chunks


def _splits(before: list[Lexeme], after: list[Lexeme], negated: bool) -> bool:
    rest: list[Lexeme] = []
    for lexeme in after:
        if lexeme.has("clause", "negation"):
            break
        rest.append(lexeme)
    if negated:
        return _has_head(rest)
    if not _has_head(rest) or _starts_with_relation(rest):
        return False
    if any(x.senses.get("relation") == "between" for x in before):
        return False
    return _has_head(before)


def _starts_with_relation(lexemes: list[Lexeme]) -> bool:
    first = next((x for x in lexemes if not x.has("noise")), None)
    return first is not None and first.has("relation", "view")


def _has_head(lexemes: list[Lexeme]) -> bool:
    only_color = all(x.has("color") for x in lexemes if x.has("name"))
    names = any(x.has("name", "category", "standin", "anything") for x in lexemes)
    if lexemes and names and only_color and not any(x.has("category", "standin", "anything") for x in lexemes):
        return lexemes[-1].has("name")
    return names or any(x.has("use") and _use_counts(lexemes, i) for i, x in enumerate(lexemes))


def _use_counts(lexemes: list[Lexeme], i: int) -> bool:
    """Whether the use at i is meant as one, and not as a command or an adjective ("hold the mug", "the open box")."""
    lexeme = lexemes[i]
    *before, last = lexeme.words
    if before or last in _STATES or last.endswith("ing"):
        return True
    if lexeme.senses["use"] in _NOUN_USES:
        return True
    return i > 0 and lexemes[i - 1].words[-1] in _USE_MARKERS


@dataclass
class _Parser:
    """Reads one chunk from left to right into a Wanted."""

    lexemes: list[Lexeme]
    depth: int = 0
    thing: Wanted = field(default_factory=Wanted)
    tone: str = ""
    ordinal: int | None = None
    last_name_at: int = -2
    standin_at: int | None = None
    object_of_use: bool = False

    def parse(self) -> Wanted:
        i = 0
        while i < len(self.lexemes):
            i = self._step(i)
        thing = self.thing
        if self.tone and not thing.colors:
            thing = replace(thing, colors=(ColorWish("black" if self.tone == "dark" else "white"),))
        if self.ordinal and thing.superlative is None and self.ordinal > 1:
            thing = replace(thing, superlative=Superlative("leftmost", self.ordinal))
        return thing

    def _step(self, i: int) -> int:
        """Read the lexeme at i and return the index of the next one to read."""
        lexeme = self.lexemes[i]
        senses = lexeme.senses
        skip_to = self._part(i) or self._detail(i)
        if skip_to is not None:
            return skip_to
        if lexeme.has("superlative") and not (lexeme.has("relation") and self._landmark_follows(i)):
            self._superlative(senses["superlative"])
        elif lexeme.has("relation") and (end := self._relation(i, senses["relation"])) is not None:
            return end
        elif lexeme.has("use") and not self._reads_as_name(i) and _use_counts(self.lexemes, i):
            self._use(i, senses["use"])
        elif lexeme.has("tone") and not lexeme.has("name"):
            self.tone = senses["tone"]
        elif lexeme.has("color") and not (lexeme.has("name") and not self._noun_follows(i)):
            self._color(i, senses["color"])
        elif lexeme.has("name"):
            self._name(i, senses["name"])
        elif lexeme.has("category"):
            self._category(i, senses["category"])
        elif lexeme.has("view"):
            self._view(senses["view"])
        elif lexeme.has("ordinal"):
            self.ordinal = int(senses["ordinal"])
        elif lexeme.has("shape"):
            self.thing = replace(self.thing, shapes=_added(self.thing.shapes, senses["shape"]))
        elif lexeme.has("size"):
            self.thing = replace(self.thing, sizes=_added(self.thing.sizes, senses["size"]))
        elif lexeme.has("standin", "anything"):
            self.standin_at = i
            if lexeme.has("anything") and not self.thing.has_noun:
                self.thing = replace(self.thing, anything=True)
        return i + 1

    def _superlative(self, key: str) -> None:
        self.thing = replace(self.thing, superlative=Superlative(key, self.ordinal or 1))
        self.ordinal = None

    def _view(self, view: str) -> None:
        if self.ordinal and view in ("left", "right"):
            self._superlative(f"{view}most")
        else:
            self.thing = replace(self.thing, views=_added(self.thing.views, view))

    def _color(self, i: int, word: str) -> None:
        either = any(x.text in ("or", "nor") for x in self.lexemes[:i]) and bool(self.thing.colors)
        self.thing = replace(
            self.thing,
            colors=_added(self.thing.colors, ColorWish(word, self.tone)),
            any_color=self.thing.any_color or either,
        )
        self.tone = ""

    def _name(self, i: int, name: str) -> None:
        if self.object_of_use and not self._instrument_marked(i):
            return
        if self.thing.categories and any(x.text == "for" for x in self.lexemes[max(0, i - 3) : i]):
            return
        said = self.lexemes[i].text
        follows_of = i >= 2 and self.lexemes[i - 1].text == "of" and self.last_name_at == i - 2
        if follows_of:
            joined = tuple(self.lexemes[i].words) + tuple(self.lexemes[i - 2].words)
            senses = load_vocabulary().phrases.get(joined, {})
            if "name" in senses:
                self._set_name(i, senses["name"], " ".join(joined))
            elif self.lexemes[i - 2].has("measure"):
                self._set_name(i, name, said)
        elif self.last_name_at == i - 1 and set(self.thing.names) & load_knowledge().kinds_of(name):
            self.last_name_at = i
        elif not self.thing.names or self.last_name_at == i - 1 or self._instrument_marked(i):
            self._set_name(i, name, said)

    def _set_name(self, i: int, name: str, said: str) -> None:
        if tuple(map(stem, name.split())) == tuple(said.split()):
            said = name
        self.thing = replace(self.thing, names=(name,), categories=(), uses=(), said=said, anything=False)
        self.last_name_at = i

    def _category(self, i: int, category: str) -> None:
        if self.object_of_use and not self._instrument_marked(i):
            return
        if not self.thing.names and not self.thing.categories:
            self.thing = replace(self.thing, categories=(category,), uses=(), said=self.lexemes[i].text, anything=False)

    def _use(self, i: int, use: str) -> None:
        if self.thing.names or self.thing.uses:
            self.object_of_use = True
            return
        self.thing = replace(self.thing, uses=(use,), anything=False)
        stands_for = self.standin_at is not None or bool(self.thing.categories)
        self.object_of_use = stands_for or use in load_vocabulary().instrument_uses

    def _instrument_marked(self, i: int) -> bool:
        """Whether "with the" or "using a" stands before the lexeme at i, after a use."""
        if not self.thing.uses:
            return False
        before = [x.text for x in self.lexemes[max(0, i - 3) : i]]
        return any(w in _INSTRUMENT_MARKERS for w in before)

    def _reads_as_name(self, i: int) -> bool:
        """Whether a word that is a name and a use ("drill", "comb", "brush") is meant as the name here."""
        lexeme = self.lexemes[i]
        return lexeme.has("name") and not (i > 0 and self.lexemes[i - 1].text in ("to", "can", "could"))

    def _noun_follows(self, i: int) -> bool:
        for lexeme in self.lexemes[i + 1 :]:
            if lexeme.has("relation", "view", "clause"):
                return False
            if lexeme.has("name", "category", "standin") or _is_unknown(lexeme):
                return True
        return False

    def _landmark_follows(self, i: int) -> bool:
        for lexeme in self.lexemes[i + 1 :]:
            if lexeme.has("standin", "clause", "view"):
                return False
            if lexeme.has("name", "category"):
                return self.lexemes[i + 1].text in ("to", "the", "a") or self.thing.has_noun
        return False

    def _part(self, i: int) -> int | None:
        """Read "by its handle", "the handle of the mug", "the mug's handle"; return the index after it."""
        lexeme = self.lexemes[i]
        if not lexeme.has("part") or (lexeme.has("name") and not self._of_a_thing(i)):
            return None
        before = [x.text for x in self.lexemes[max(0, i - 2) : i]]
        after = self.lexemes[i + 1].text if i + 1 < len(self.lexemes) else ""
        marked = bool(_PART_MARKERS.intersection(before))
        of_what = after == "of" and "on" not in before and not lexeme.has("view")
        owned = self.last_name_at == i - 1 and self.last_name_at >= 0 and not lexeme.has("view")
        if not (marked or of_what or owned):
            return None
        if of_what and not self.thing.has_noun:  # "the red cap of the bottle": what was said so far is the part's
            self.thing = replace(self.thing, colors=(), shapes=(), sizes=())
            self.tone = ""
        self.thing = replace(self.thing, part=self.thing.part or lexeme.text)
        return i + (2 if of_what else 1)

    def _of_a_thing(self, i: int) -> bool:
        """Whether "of" and the name of a thing follow: "the lid of the bottle" is a part, though a lid is a thing."""
        if i + 1 >= len(self.lexemes) or self.lexemes[i + 1].text != "of":
            return False
        what = next((x for x in self.lexemes[i + 2 :] if not x.has("noise", "color", "tone", "size", "shape")), None)
        return what is not None and what.has("name")

    def _detail(self, i: int) -> int | None:
        """Skip "with a white cap": the colour of a part is not that of the thing."""
        if self.lexemes[i].text != "with" or not self.thing.names:
            return None
        for k in range(i + 1, min(i + 5, len(self.lexemes))):
            if self.lexemes[k].has("part"):
                return k + 1
        return None

    def _relation(self, i: int, kind: str) -> int | None:
        """Read a relation and its landmark up to the end; None where no landmark follows."""
        rest = self.lexemes[i + 1 :]
        if kind == "next to" and any(x.has("part") and not x.has("name") for x in rest[:2]):
            return None
        if self.depth >= MAX_LANDMARK_DEPTH or not rest:
            return None
        surface = next((x for x in rest if not x.has("noise", "color", "tone", "size") or x.has("surface")), None)
        if surface is not None and surface.has("surface") and not surface.has("name", "category"):
            view = _VIEW_OF_RELATION.get(kind)
            if view:
                self._view(view)
            elif self.standin_at is not None and not self.thing.understood:
                self.thing = replace(self.thing, anything=True)
            return i + 1 + rest.index(surface) + 1
        if self.thing.has_noun and any(x.has("destination") for x in self.lexemes[:i]):
            return len(self.lexemes)
        end = len(rest) if kind == "between" else _next_relation(rest)
        groups = _split_between(rest) if kind == "between" else [rest[:end]]
        landmarks: list[Wanted] = []
        part: str | None = None
        for group in groups:
            landmark = _Parser(group, self.depth + 1).parse()
            part = part or landmark.part
            landmark = replace(landmark, part=None)
            if landmark.has_noun or landmark.colors or landmark.shapes:
                landmarks.append(landmark)
        if not landmarks:
            return None
        self.thing = replace(
            self.thing,
            relations=(*self.thing.relations, RelationWish(kind, tuple(landmarks))),
            part=self.thing.part or part,
        )
        return i + 1 + end


def _next_relation(lexemes: list[Lexeme]) -> int:
    """Return where "and behind ..." starts, which belongs to the thing and not to its landmark; else the length."""
    for i, lexeme in enumerate(lexemes):
        if lexeme.has("clause") and _starts_with_relation(lexemes[i + 1 :]):
            return i
    return len(lexemes)


def _split_between(lexemes: list[Lexeme]) -> list[list[Lexeme]]:
    groups: list[list[Lexeme]] = [[]]
    for lexeme in lexemes:
        if lexeme.text == "and":
            groups.append([])
        else:
            groups[-1].append(lexeme)
    return groups


def _added(items: tuple[T, ...], item: T) -> tuple[T, ...]:
    return items if item in items else (*items, item)
