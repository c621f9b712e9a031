"""From text to known words: normalising, plurals, one-letter typos, phrases longest first."""

from __future__ import annotations

import re
import string
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

from thinkgrasp.language.knowledge import Knowledge, load_knowledge

MIN_TYPO_LENGTH = 4
MAX_TYPO_LENGTH = 20

_IRREGULAR = {
    "knives": "knife",
    "loaves": "loaf",
    "mice": "mouse",
    "teeth": "tooth",
    "shoes": "shoe",
    "leaves": "leaf",
    "dice": "die",
    "halves": "half",
}
_TOKEN = re.compile(r"\w+(?:'\w+)?|[,;.!?]")
_SENTENCE_ENDS = frozenset(".!?")


@dataclass(frozen=True)
class Lexeme:
    """One known word or phrase of a sentence, or one unknown word, with every sense that it may have."""

    words: tuple[str, ...]
    senses: Mapping[str, str]
    """Sense (name, color, use, ...) to value; empty for an unknown word."""

    def has(self, *senses: str) -> bool:
        """Return whether the phrase may have any of these senses."""
        return any(s in self.senses for s in senses)

    @property
    def text(self) -> str:
        """The words as one string."""
        return " ".join(self.words)


@dataclass(frozen=True)
class Vocabulary:
    """Phrases and what they may mean."""

    phrases: Mapping[tuple[str, ...], Mapping[str, str]]
    longest: int
    words: frozenset[str]
    protected: frozenset[str]
    colors: Mapping[str, tuple[str, ...]]
    """Colour word to the colour names it may show as, the first counts most."""
    instrument_uses: frozenset[str]
    parts: Mapping[str, str]
    """Word for a part to the place where it is found, unless the object's own knowledge says otherwise."""
    ordinals: Mapping[str, int]

    def correct(self, word: str) -> str:
        """Return the known word that is one insertion, deletion, change or swap of letters away, or the word itself."""
        known = word in self.words or word in self.protected
        if known or not MIN_TYPO_LENGTH <= len(word) <= MAX_TYPO_LENGTH or not word.isalpha() or not word.isascii():
            return word
        for candidates in _one_edit_away(word):
            near = sorted(
                (c for c in candidates if c in self.words and len(c) >= 3), key=lambda c: (c[0] != word[0], -len(c), c)
            )
            if near:
                return near[0]
        return word


def stem(word: str) -> str:
    """Return the singular of an English word, by the same rules for the vocabulary and for what was said."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) > 4 and word.endswith("ies"):
        return word[:-3] + "y"
    if len(word) > 4 and word.endswith(("ches", "shes", "xes", "sses", "oes")):
        return word[:-2]
    if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is", "'s")):
        return word[:-1]
    return word


def tokenise(text: str) -> list[list[str]]:
    """Split text into sentences of stemmed lower-case words; commas and semicolons stay as tokens."""
    text = unicodedata.normalize("NFKD", text.replace("’", "'")).casefold()
    text = unicodedata.normalize("NFC", "".join(c for c in text if not "\u0300" <= c <= "\u036f"))
    sentences: list[list[str]] = [[]]
    for token in _TOKEN.findall(re.sub(r"[-_/]", " ", text)):
        if token in _SENTENCE_ENDS:
            sentences.append([])
        else:
            sentences[-1].append(stem(token.removesuffix("'s").removesuffix("'")))
    return [s for s in sentences if s]


def read(text: str, vocabulary: Vocabulary | None = None) -> list[list[Lexeme]]:
    """Read text into sentences of lexemes, matching the longest known phrase at each place."""
    vocabulary = vocabulary or load_vocabulary()
    return [_match(tokens, vocabulary) for tokens in tokenise(text)]


def _corrected(tokens: list[str], vocabulary: Vocabulary) -> list[str]:
    """Mend typos; not where at least as many words stay strange, for that is another language, or nonsense."""
    mended = [vocabulary.correct(t) for t in tokens]
    strange = [t for t in mended if t.isalpha() and t not in vocabulary.words and t not in vocabulary.protected]
    words = sum(t.isalpha() for t in tokens)
    return tokens if 2 * len(strange) >= words else mended


def _match(tokens: list[str], vocabulary: Vocabulary) -> list[Lexeme]:
    tokens = _corrected(tokens, vocabulary)
    lexemes: list[Lexeme] = []
    i = 0
    while i < len(tokens):
        for n in range(min(vocabulary.longest, len(tokens) - i), 0, -1):
            words = tuple(tokens[i : i + n])
            senses = vocabulary.phrases.get(words)
            if senses is not None or n == 1:
                lexemes.append(Lexeme(words, senses or {}))
                i += n
                break
    return lexemes


def _one_edit_away(word: str) -> Iterator[set[str]]:
    splits = [(word[:i], word[i:]) for i in range(len(word) + 1)]
    letters = string.ascii_lowercase
    yield {a + b[1] + b[0] + b[2:] for a, b in splits if len(b) > 1}
    yield {a + b[1:] for a, b in splits if b} | {a + c + b for a, b in splits for c in letters}
    yield {a + c + b[1:] for a, b in splits if b for c in letters}


@lru_cache(maxsize=1)
def load_vocabulary() -> Vocabulary:
    """Return the words that ship with the package, joined with the names of the household knowledge; read once."""
    text = resources.files("thinkgrasp.language").joinpath("vocabulary.toml").read_text(encoding="utf-8")
    return _build(tomllib.loads(text), load_knowledge())


def _build(data: Mapping[str, Any], knowledge: Knowledge) -> Vocabulary:
    phrases: dict[tuple[str, ...], dict[str, str]] = {}

    def add(phrase: str, sense: str, value: str) -> None:
        words = tuple(stem(w) for w in re.sub(r"[-_]", " ", phrase).split())
        phrases.setdefault(words, {}).setdefault(sense, value)

    for obj in knowledge.objects.values():
        add(obj.name, "name", obj.name)
    for obj in knowledge.objects.values():
        for synonym in obj.synonyms:
            add(synonym, "name", obj.name)
    for word in data["colors"]:
        add(word, "color", word)
    for word, value in data["ordinals"].items():
        add(word, "ordinal", str(value))
    sections = {
        "tones": "tone",
        "shapes": "shape",
        "sizes": "size",
        "superlatives": "superlative",
        "views": "view",
        "relations": "relation",
        "parts": "part",
        "uses": "use",
        "categories": "category",
    }
    for section, sense in sections.items():
        for value, said in data[section].items():
            for phrase in said:
                add(phrase, sense, value)
    lists = {
        "surface": data["surfaces"]["words"],
        "measure": data["measures"]["words"],
        "negation": data["negations"]["words"],
        "clause": data["clause"]["words"],
        "standin": data["anything"]["words"],
        "anything": data["anything"]["free"],
        "noise": data["noise"]["words"].split(),
        "request": data["requests"]["words"],
        "destination": data["destinations"]["words"],
    }
    for sense, words in lists.items():
        for word in words:
            add(word, sense, word)
    return Vocabulary(
        phrases=phrases,
        longest=max(map(len, phrases)),
        words=frozenset(w for p in phrases for w in p),
        protected=frozenset(stem(w) for w in data["protected"]["words"].split()),
        colors={w: tuple(names) for w, names in data["colors"].items()},
        instrument_uses=frozenset(data["instrument"]["uses"]),
        parts={word: data["part_places"][part] for part, said in data["parts"].items() for word in said},
        ordinals=data["ordinals"],
    )
