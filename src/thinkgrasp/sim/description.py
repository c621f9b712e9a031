"""`object.toml`: what a person calls an object, and what it is for."""

from __future__ import annotations

import difflib
import re
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from thinkgrasp.errors import InputError
from thinkgrasp.language import COLOR_NAMES
from thinkgrasp.language.knowledge import KnownObject, load_knowledge
from thinkgrasp.language.vocabulary import read

KEYS = ("name", "category", "colors", "uses")


@dataclass(frozen=True)
class Description:
    """Words for an object; no colours = none were given."""

    name: str
    category: str
    colors: tuple[str, ...]
    uses: tuple[str, ...]


@lru_cache(maxsize=1024)
def known_kind(name: str) -> KnownObject | None:
    """Return the kind in the household knowledge that a name ends in, by its name or a synonym, or None.

    "soup can" and "my tomato soup can" are a tomato soup can, "mug 2" is a mug.
    """
    kinds = [lexeme.senses["name"] for sentence in read(name) for lexeme in sentence if lexeme.has("name")]
    return load_knowledge().objects[kinds[-1]] if kinds else None


def read_description(path: Path, folder_name: str) -> Description:
    """Read an object.toml; what it does not say follows from the name, and the name from the folder.

    Args:
        path: The file; it need not exist.
        folder_name: "RedMug_2" is taken for "red mug 2".

    Raises:
        InputError: The file cannot be read, has an unknown key, a value of the wrong type, or an unknown colour.
    """
    given = _Given(path)
    name = given.text("name") or " ".join(re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", folder_name)).lower()
    if not name:
        raise InputError(f"{path.parent}: no name follows from the folder {folder_name!r}; give one in {path.name}")
    kind = known_kind(name)
    category = given.text("category") or (kind.categories[0] if kind and kind.categories else "object")
    colors, uses = given.texts("colors"), given.texts("uses")
    for color in colors or ():
        if color not in COLOR_NAMES:
            raise given.error("colors", f"unknown colour {color!r}; allowed are {', '.join(COLOR_NAMES)}")
    return Description(name, category, colors or (), (kind.uses if kind else ()) if uses is None else uses)


class _Given:
    """The entries of a file, with the line of each."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.source = path.read_text(encoding="utf-8") if path.exists() else ""
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read: {error}") from error
        try:
            self.entries = tomllib.loads(self.source)
        except tomllib.TOMLDecodeError as error:
            line = re.search(r"at line (\d+)", str(error))
            at = line.group(1) if line else str(self.source.count("\n") + 1)
            raise InputError(f"{path}:{at}: not TOML: {error}") from error
        for key in self.entries:
            if key not in KEYS:
                close = difflib.get_close_matches(key, KEYS, n=1)
                hint = f" Did you mean {close[0]!r}?" if close else ""
                raise self.error(key, f"unknown key {key!r}; allowed are {', '.join(KEYS)}.{hint}")

    def error(self, key: str, message: str) -> InputError:
        """Return an error that points at the line of an entry."""
        pattern = re.compile(rf"\s*[\[\"']*{re.escape(key)}\b")
        lines = enumerate(self.source.splitlines(), start=1)
        at = next((i for i, line in lines if pattern.match(line)), 1)
        return InputError(f"{self.path}:{at}: {message}")

    def text(self, key: str) -> str | None:
        """Return a text that is not blank, in lower case with single spaces, or None where it is not given."""
        value = self.entries.get(key)
        if value is None:
            return None
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, f"{key} must be a text, got {value!r}")
        return " ".join(value.lower().split())

    def texts(self, key: str) -> tuple[str, ...] | None:
        """Return a list of texts, or None where it is not given."""
        value = self.entries.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or not all(isinstance(v, str) and v.strip() for v in value):
            raise self.error(key, f"{key} must be a list of texts, got {value!r}")
        return tuple(v.strip().lower() for v in value)
