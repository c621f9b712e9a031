"""VLPart in small: random weights, a text tower with a toy tokeniser, and the golden data where it is there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from thinkgrasp.networks.swin import SwinConfig
from thinkgrasp.networks.vlpart import VLPart, VLPartConfig

SHARED = Path(__file__).resolve().parents[3] / "shared" / "vlpart"
TINY = VLPartConfig(SwinConfig(8, (1, 2, 1, 1), (1, 1, 2, 4)), 8, 16, 24, short_side_px=128, long_side_px=200)


def golden(name: str) -> Mapping[str, np.ndarray]:
    """Return a file of golden arrays, or skip the test."""
    path = SHARED / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no golden data at {path}")
    return np.load(path)


def random_weights(shapes: Mapping[str, Tensor], seed: int = 0) -> dict[str, Tensor]:
    """Return weights that keep the size of what passes through them."""
    g = torch.Generator().manual_seed(seed)
    weights: dict[str, Tensor] = {}
    for name, like in shapes.items():
        if like.ndim == 1:
            weights[name] = torch.zeros(like.shape) if name.endswith("bias") else torch.ones(like.shape)
        else:
            weights[name] = torch.randn(like.shape, generator=g) * like[0].numel() ** -0.5
    return weights


def tiny_weights(config: VLPartConfig = TINY, seed: int = 0) -> dict[str, Tensor]:
    """Return random weights for a configuration, by the checkpoint's names."""
    with torch.device("meta"):
        shapes = VLPart(config).state_dict()
    return random_weights(shapes, seed)


WORDS = ("a", "mug", "handle", "knife", "background", "red", "box", "thing")


def save_tokenizer(folder: Path) -> int:
    """Write vocab.json and merges.txt that know WORDS and single letters; return the number of tokens."""
    folder.mkdir(parents=True, exist_ok=True)
    letters = [chr(c) for c in range(33, 127)]
    tokens = dict.fromkeys([*letters, *(f"{c}</w>" for c in letters)])
    merges: list[str] = []
    for word in WORDS:
        parts = [*word[:-1], f"{word[-1]}</w>"]
        while len(parts) > 1:
            merges.append(f"{parts[0]} {parts[1]}")
            parts = [parts[0] + parts[1], *parts[2:]]
            tokens[parts[0]] = None
    vocabulary = {token: i for i, token in enumerate([*tokens, "<|startoftext|>", "<|endoftext|>"])}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *dict.fromkeys(merges)]) + "\n")
    return len(vocabulary)


def tower_weights(vocabulary: int, width: int = 64, out: int = TINY.text_width, layers: int = 2) -> dict[str, Tensor]:
    """Return random weights of a text tower by OpenAI's names."""
    shapes = {
        "token_embedding.weight": (vocabulary, width),
        "positional_embedding": (77, width),
        "ln_final.weight": (width,),
        "ln_final.bias": (width,),
        "text_projection": (width, out),
    }
    for n in range(layers):
        block = f"transformer.resblocks.{n}."
        shapes |= {
            f"{block}attn.in_proj_weight": (3 * width, width),
            f"{block}attn.in_proj_bias": (3 * width,),
            f"{block}attn.out_proj.weight": (width, width),
            f"{block}attn.out_proj.bias": (width,),
            f"{block}mlp.c_fc.weight": (4 * width, width),
            f"{block}mlp.c_fc.bias": (4 * width,),
            f"{block}mlp.c_proj.weight": (width, 4 * width),
            f"{block}mlp.c_proj.bias": (width,),
        }
        shapes |= {f"{block}ln_{i}.{part}": (width,) for i in (1, 2) for part in ("weight", "bias")}
    return random_weights({name: torch.empty(shape, device="meta") for name, shape in shapes.items()}, seed=1)


def save_checkpoint(folder: Path, *, text: bool = True) -> tuple[Path, Path]:
    """Write a tiny checkpoint in the official file's form and a tokeniser; return both paths."""
    vocabulary = save_tokenizer(folder / "tokenizer")
    weights = tiny_weights()
    if text:
        weights |= {f"text_encoder.{name}": value for name, value in tower_weights(vocabulary).items()}
    torch.save({"model": weights}, folder / "vlpart.pth")
    return folder / "vlpart.pth", folder / "tokenizer"
