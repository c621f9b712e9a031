"""Boxes of named objects and parts in an image: VLPart with its weights, its text, and what it remembers."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thinkgrasp.errors import ConfigError
from thinkgrasp.networks.checkpoint import choose_device, read_checkpoint
from thinkgrasp.networks.clip_text import PREFIX, TOKENIZER, TOKENIZER_REVISION, ClipText, text_weights, tower_in
from thinkgrasp.networks.part_text import BACKGROUND, EncodedText, PartText, TextTable, sentence, split_vocabulary
from thinkgrasp.networks.vlpart import WHAT, Regions, Variant, VLPart, VLPartConfig, load_vlpart, text_matrix

RN50_URL = (
    "https://openaipublic.azureedge.net/clip/models/"
    "afeb0e10f9e5a86da6080e35cf09123aca3b358a0c3e3b6c78a7b63bc04b6762/RN50.pt"
)
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
KEPT_IMAGES = 2
"""What these last images hold is remembered: a frame, and a crop of it."""


@dataclass(frozen=True)
class TextSource:
    """Where the vectors of names come from.

    Raises:
        ConfigError: Both a table and weights are named.
    """

    weights: str | Path | None = None
    """As `text_weights` takes it; None = those inside the VLPart checkpoint."""
    table: str | Path | None = None
    """Of fixed names, as `TextTable` takes it, instead of a text tower."""
    tokenizer: str | Path = TOKENIZER
    tokenizer_revision: str = TOKENIZER_REVISION
    cache: Path | None = None
    """Folder for vectors that have been computed once."""

    def __post_init__(self) -> None:
        if self.weights is not None and self.table is not None:
            raise ConfigError(f"{WHAT}: give either a text table or text weights, not both")

    def open(self, checkpoint: Mapping[str, Tensor], width: int, device: torch.device) -> PartText:
        """Return the source, ready.

        Args:
            checkpoint: VLPart's, which may hold the text tower.
            width: Length that the vectors must have.
            device: Where a text tower runs.

        Raises:
            ConfigError: There is none, it cannot be read, or its vectors have another length.
            MissingDependency: A package for it is not installed.
        """
        if self.table is not None:
            table = TextTable(self.table)
            _check_width(table.width, width, f"the table {self.table}")
            return table
        weights = tower_in(checkpoint) if self.weights is None else text_weights(self.weights)
        if not weights:
            raise ConfigError(
                f"{WHAT}: the checkpoint holds no text tower ({PREFIX}*); give text_weights=RN50.pt, OpenAI's CLIP "
                f"({RN50_URL}), or text_table=FILE.npz"
            )
        tower = ClipText(
            weights,
            tokenizer=self.tokenizer,
            revision=self.tokenizer_revision,
            device=device,
        )
        _check_width(tower.width, width, "this text tower (only CLIP's RN50 fits)")
        return EncodedText(tower, self.cache)


@dataclass(frozen=True, eq=False)
class PartBoxes:
    """What was found, best first."""

    names: tuple[str, ...]
    """(D,) the name each box was found for."""
    boxes_xyxy: NDArray[np.float32]
    """(D, 4) [px], inside the image."""
    scores: NDArray[np.float32]
    """(D,) 0..1."""


class PartFinder:
    """Find named objects and parts; a second question about the same image costs only the comparison with the text.

    Args:
        weights: VLPart's checkpoint.
        text: Where the vectors of names come from.
        variant: Which boxes are kept and how they are scored, as `VARIANTS` says; None = as `config` says.
        config: Sizes; None = the Swin-B checkpoint's.
        device: None = a CUDA device where there is one, else the CPU.
        dtype: One of DTYPES; boxes and scores are float32 throughout.

    Raises:
        ConfigError: A file cannot be used, weights are missing, or a setting is not allowed.
        MissingDependency: A package for the text is not installed.
    """

    def __init__(
        self,
        weights: str | Path,
        text: TextSource,
        *,
        variant: Variant | None = "paper",
        config: VLPartConfig | None = None,
        device: str | None = None,
        dtype: str = "float32",
    ) -> None:
        if dtype not in DTYPES:
            raise ConfigError(f"{WHAT}: dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
        config = config or VLPartConfig()
        config = config if variant is None else config.variant(variant)
        place = choose_device(device, what=WHAT)
        checkpoint = read_checkpoint(weights, what=WHAT)
        self.model: VLPart
        self.model, unused = load_vlpart(checkpoint, config, device=place, dtype=DTYPES[dtype])
        self._text = text.open(checkpoint, config.text_width, place)
        own_text = text.weights is None and text.table is None
        self.unused = tuple(name for name in unused if not (own_text and name.startswith(PREFIX)))
        """Names in the checkpoint that serve nothing here."""
        self._seen: OrderedDict[tuple[bytes, tuple[int, ...]], Regions] = OrderedDict()

    def find(self, color: NDArray[np.uint8], names: Sequence[str]) -> PartBoxes:
        """Return the boxes of an image that answer to names; empty without names.

        Args:
            color: (H, W, 3) RGB.
            names: "mug:handle", "mug", ...; or a vocabulary in one text, as `split_vocabulary` takes it.

        Raises:
            InputError: The image is none, or a name has no vector.
        """
        names = split_vocabulary(names) if isinstance(names, str) else names
        if not names:
            return PartBoxes((), np.zeros((0, 4), np.float32), np.zeros(0, np.float32))
        features = self._text.features([*(sentence(name) for name in names), BACKGROUND])
        text = text_matrix(features[:-1], features[-1], self.model.config.selection)
        found = self.model.detect(self._regions(color), text.to(self.model.device))
        answered = tuple(names[int(i)] for i in found.classes)
        return PartBoxes(answered, found.boxes.cpu().numpy(), found.scores.cpu().numpy())

    def notes(self) -> tuple[str, ...]:
        """Return what went wrong without harm since this was last asked."""
        return self._text.notes()

    def _regions(self, color: NDArray[np.uint8]) -> Regions:
        key = (hashlib.blake2b(np.ascontiguousarray(color).data, digest_size=16).digest(), color.shape)
        if key in self._seen:
            self._seen.move_to_end(key)
            return self._seen[key]
        self._seen[key] = regions = self.model.regions(color)
        if len(self._seen) > KEPT_IMAGES:
            self._seen.popitem(last=False)
        return regions


def _check_width(got: int, wanted: int, source: str) -> None:
    if got != wanted:
        raise ConfigError(f"{WHAT}: the vectors of {source} have {got} numbers; the detector compares {wanted}")
