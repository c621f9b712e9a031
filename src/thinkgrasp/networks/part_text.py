"""What VLPart is asked for: names of objects and parts, as sentences and as vectors.

References:
    [Sun2023] VLPart's prompts; names as in PACO and Pascal Part: "mug", "mug:handle", "bus:license plate".
"""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.networks.clip_text import ClipText
from thinkgrasp.outputs import write_atomic

WHAT = "VLPart text"
BACKGROUND = "background"
"""Encoded as it stands, without "a"."""


def split_vocabulary(text: str) -> tuple[str, ...]:
    """Return the names, as written, that full stops separate; empty ones are dropped."""
    return tuple(name for name in text.split(".") if name.strip())


def sentence(name: str) -> str:
    """Return what is encoded for a name: "mug:handle" -> "a mug handle"."""
    return "a " + name.lower().replace(":", " ")


class PartText(Protocol):
    """Vectors of sentences."""

    def features(self, sentences: Sequence[str]) -> Tensor:
        """Return (N, text_width) float32, not normalised.

        Raises:
            InputError: A sentence cannot be encoded.
        """
        ...

    def notes(self) -> tuple[str, ...]:
        """Return what went wrong without harm since this was last asked."""
        ...


class EncodedText:
    """Vectors from the text tower, kept in memory and in a folder.

    Args:
        tower: CLIP's text tower.
        cache: Folder; it is made. None = in memory only.

    Raises:
        ConfigError: The folder cannot be made or written.
    """

    def __init__(self, tower: ClipText, cache: Path | None) -> None:
        self._tower, self._cache = tower, cache
        self._known: dict[str, Tensor] = {}
        self._notes: list[str] = []
        if cache is not None:
            try:
                cache.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"{WHAT}: the cache folder {cache} cannot be made: {error}") from None
            if not os.access(cache, os.W_OK):
                raise ConfigError(f"{WHAT}: the cache folder {cache} cannot be written; give another one, or none")

    def features(self, sentences: Sequence[str]) -> Tensor:
        """Return (N, text_width) float32; each sentence is encoded once for these weights."""
        new = [text for text in dict.fromkeys(sentences) if text not in self._known]
        ids = self._tower.token_ids(new)
        for text, row in zip(new, ids, strict=True):
            found = self._read(row)
            if found is None:
                found = self._tower.encode(row[None])[0]
                self._write(row, found)
            self._known[text] = found
        return torch.stack([self._known[text] for text in sentences])

    def notes(self) -> tuple[str, ...]:
        """Return which cached files were unusable since this was last asked."""
        notes, self._notes = tuple(self._notes), []
        return notes

    def _file(self, ids: Tensor) -> Path | None:
        key = hashlib.blake2b(self._tower.digest.encode() + ids.numpy().tobytes(), digest_size=16).hexdigest()
        return None if self._cache is None else self._cache / f"{key}.npy"

    def _read(self, ids: Tensor) -> Tensor | None:
        path = self._file(ids)
        if path is None or not path.is_file():
            return None
        try:
            vector = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            self._notes.append(f"the cached text vector {path} cannot be read ({reason})")
            return None
        fits = isinstance(vector, np.ndarray) and vector.shape == (self._tower.width,) and vector.dtype == np.float32
        if not fits or not np.isfinite(vector).all():
            self._notes.append(f"the cached text vector {path} is damaged")
            return None
        return torch.from_numpy(vector)

    def _write(self, ids: Tensor, vector: Tensor) -> None:
        path = self._file(ids)
        if path is None:
            return
        buffer = BytesIO()
        np.save(buffer, vector.numpy(), allow_pickle=False)
        try:
            write_atomic(path, buffer.getvalue())
        except InputError as error:
            self._notes.append(f"the text vector could not be cached: {error}")


class TextTable:
    """Vectors of fixed names from a file, without a text tower.

    Args:
        path: A .npz file with `names` (C,) text and `features` (C, text_width) float; "background" may be among them.

    Raises:
        ConfigError: It is no such file.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = path = Path(path).expanduser()
        try:
            with np.load(path, allow_pickle=False) as table:
                names, features = table["names"], table["features"]
        except FileNotFoundError:
            raise ConfigError(f"{WHAT}: the table {path} does not exist") from None
        except (OSError, ValueError, EOFError, KeyError, TypeError, AttributeError, BadZipFile) as error:
            raise ConfigError(
                f"{WHAT}: {path} is no table of text vectors ({error}); it is a .npz file with names (C,) and features "
                "(C, text_width)"
            ) from None
        fits = names.ndim == 1 and names.dtype.kind == "U" and features.ndim == 2 and features.dtype.kind == "f"
        if not fits or len(names) != len(features) or not len(names) or not np.isfinite(features).all():
            raise ConfigError(
                f"{WHAT}: the table {path} needs names (C,) text and features (C, text_width) finite numbers, got "
                f"{names.shape} {names.dtype} and {features.shape} {features.dtype}"
            )
        vectors = torch.from_numpy(features.astype(np.float32))
        self._vectors = {_key(name): vector for name, vector in zip(names.tolist(), vectors, strict=True)}
        self.width = features.shape[1]

    def features(self, sentences: Sequence[str]) -> Tensor:
        """Return (N, text_width) float32.

        Raises:
            InputError: A sentence is not in the table; the nearest ones are named.
        """
        for text in sentences:
            if _plain(text) not in self._vectors and text != BACKGROUND:
                near = difflib.get_close_matches(_plain(text), self._vectors, n=3)
                raise InputError(
                    f"{WHAT}: {text!r} is not among the {len(self._vectors)} names of {self._path}"
                    + (f"; near it are {', '.join(near)}" if near else "")
                )
        nothing = torch.zeros(self.width)
        return torch.stack([self._vectors.get(_plain(text), nothing) for text in sentences])

    def notes(self) -> tuple[str, ...]:
        """Return nothing: a table has been read whole."""
        return ()


def _key(name: str) -> str:
    return name if name == BACKGROUND else _plain(sentence(name))


def _plain(text: str) -> str:
    return " ".join(text.split())
