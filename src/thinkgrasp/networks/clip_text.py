"""CLIP's text tower: a sentence in, one vector out, in the space that VLPart compares boxes with.

VLPart was trained against the RN50 tower (vectors of 1024); the towers of other CLIP models do not fit.

References:
    [Radford2021] Learning Transferable Visual Models From Natural Language Supervision; checked against
    ../shared/vlpart/golden_text.npz.
"""

from __future__ import annotations

import hashlib
import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.networks.checkpoint import load_strictly, read_checkpoint
from thinkgrasp.networks.torchscript_weights import is_torchscript, read_torchscript

if TYPE_CHECKING:
    from transformers import CLIPTextModelWithProjection

WHAT = "CLIP text tower"
PREFIX = "text_encoder."
"""Before its names where the tower is stored inside a VLPart checkpoint."""
HEAD_WIDTH = 64
TOKENIZER = "openai/clip-vit-base-patch32"
"""All CLIP models share one tokeniser; this repository holds its files."""
TOKENIZER_REVISION = "3d74acf9a28c67741b2f4f2ea7635f0aaf6f0268"
_GET_TOKENIZER = (
    f"get CLIP's own by: hf download {TOKENIZER} vocab.json merges.txt tokenizer_config.json --revision "
    f"{TOKENIZER_REVISION}"
)

_RENAMED = (
    (r"^token_embedding\.weight$", "embeddings.token_embedding.weight"),
    (r"^positional_embedding$", "embeddings.position_embedding.weight"),
    (r"^ln_final\.", "final_layer_norm."),
    (r"^transformer\.resblocks\.(\d+)\.ln_(\d)\.", r"encoder.layers.\1.layer_norm\2."),
    (r"^transformer\.resblocks\.(\d+)\.attn\.out_proj\.", r"encoder.layers.\1.self_attn.out_proj."),
    (r"^transformer\.resblocks\.(\d+)\.mlp\.c_fc\.", r"encoder.layers.\1.mlp.fc1."),
    (r"^transformer\.resblocks\.(\d+)\.mlp\.c_proj\.", r"encoder.layers.\1.mlp.fc2."),
)
_IN_PROJECTION = re.compile(r"^transformer\.resblocks\.(\d+)\.attn\.in_proj_(weight|bias)$")


class ClipText:
    """The text tower with its tokeniser.

    Args:
        weights: By OpenAI's names, as `text_weights` returns them.
        tokenizer: A folder with vocab.json and merges.txt, or a repository of the Hugging Face hub that has been
            downloaded; nothing is downloaded here.
        revision: Commit of that repository.
        device: Where it runs; it runs in float32.

    Raises:
        ConfigError: Weights are missing, the tokeniser is not found, or the two belong to different models.
        MissingDependency: transformers is not installed.
    """

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        *,
        tokenizer: str | Path = TOKENIZER,
        revision: str = TOKENIZER_REVISION,
        device: torch.device | str = "cpu",
    ) -> None:
        self._model = load_text_tower(weights)
        self._model.to(torch.device(device))  # pyright: ignore[reportArgumentType]
        self._tokenizer = _load_tokenizer(tokenizer, revision)
        self._width = weights["text_projection"].shape[1]
        self.digest = _digest(weights)
        """Of the weights."""
        words, wanted = len(self._tokenizer), self._model.config.vocab_size
        if words != wanted:
            raise ConfigError(
                f"{WHAT}: the tokeniser {tokenizer} has {words} tokens, the weights are for {wanted}; {_GET_TOKENIZER}"
            )

    @property
    def width(self) -> int:
        """Length of the vectors."""
        return self._width

    def token_ids(self, sentences: Sequence[str]) -> Tensor:
        """Return (N, 77) int64: start, the sentence's tokens, end, zeros.

        Raises:
            InputError: A sentence is too long.
        """
        length = self._model.config.max_position_embeddings
        ids = torch.zeros(len(sentences), length, dtype=torch.int64)
        for row, sentence in zip(ids, sentences, strict=True):
            # As OpenAI's tokeniser does, and transformers' does not.
            tokens: list[int] = self._tokenizer(html.unescape(html.unescape(sentence)))["input_ids"]
            if len(tokens) > length:
                raise InputError(f"{WHAT}: {sentence[:60]!r}... has {len(tokens)} tokens; at most {length} are allowed")
            row[: len(tokens)] = torch.tensor(tokens)
        return ids

    @torch.no_grad()
    def encode(self, ids: Tensor) -> Tensor:
        """Return the vectors (N, width) float32 of token ids (N, 77), on the CPU, not normalised."""
        return self._model(input_ids=ids.to(self._model.device)).text_embeds.float().cpu()


def text_weights(path: str | Path) -> dict[str, Tensor]:
    """Return the weights of a text tower by OpenAI's names.

    Args:
        path: OpenAI's RN50.pt (a TorchScript archive, of which nothing is run), a state dict or .safetensors file with
            the same names, or a VLPart checkpoint that holds `text_encoder.*`.

    Raises:
        ConfigError: The file cannot be read, or holds no text tower.
    """
    path = Path(path).expanduser()
    archive = path.is_file() and is_torchscript(path)
    found = tower_in(read_torchscript(path, what=WHAT) if archive else read_checkpoint(path, what=WHAT))
    if not found:
        raise ConfigError(f"{WHAT}: {path} holds no text tower (no token_embedding.weight); give OpenAI's RN50.pt")
    return found


def tower_in(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the text tower's part of a checkpoint by OpenAI's names, float32; empty when there is none."""
    prefix = PREFIX if f"{PREFIX}token_embedding.weight" in weights else ""
    names = {name.removeprefix(prefix): name for name in weights if name.startswith(prefix)}
    if "token_embedding.weight" not in names:
        return {}
    towers = ("token_embedding.", "positional_embedding", "transformer.", "ln_final.", "text_projection")
    return {name: weights[full].float() for name, full in names.items() if name.startswith(towers)}


def load_text_tower(weights: Mapping[str, Tensor], *, heads: int | None = None) -> CLIPTextModelWithProjection:
    """Return transformers' text model with these weights, sized by them.

    Args:
        weights: By OpenAI's names.
        heads: Attention heads; None = one per HEAD_WIDTH channels, as in all of OpenAI's models.

    Raises:
        ConfigError: Weights are missing or do not fit together.
        MissingDependency: transformers is not installed.
    """
    try:
        from transformers import CLIPTextConfig, CLIPTextModelWithProjection
    except ModuleNotFoundError:
        raise MissingDependency("transformers", "langsam", WHAT) from None
    needed = ("token_embedding.weight", "positional_embedding", "text_projection")
    missing = [name for name in needed if name not in weights]
    if missing:
        raise ConfigError(f"{WHAT}: the weights lack {', '.join(missing)}")
    vocabulary, width = weights["token_embedding.weight"].shape
    fc = weights.get("transformer.resblocks.0.mlp.c_fc.weight")
    config = CLIPTextConfig(
        vocab_size=vocabulary,
        hidden_size=width,
        intermediate_size=4 * width if fc is None else fc.shape[0],
        projection_dim=weights["text_projection"].shape[1],
        num_hidden_layers=len({m[1] for m in map(re.compile(r"transformer\.resblocks\.(\d+)").match, weights) if m}),
        num_attention_heads=heads or max(1, width // HEAD_WIDTH),
        max_position_embeddings=weights["positional_embedding"].shape[0],
        hidden_act="quick_gelu",
        bos_token_id=vocabulary - 2,
        eos_token_id=vocabulary - 1,
        pad_token_id=0,
    )
    model = CLIPTextModelWithProjection(config)
    prefix = "text_model." if any(name.startswith("text_model.") for name in model.state_dict()) else ""
    load_strictly(model, _renamed(weights, prefix), what=WHAT)
    return model.requires_grad_(False).eval()


def _renamed(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    named: dict[str, Tensor] = {}
    for name, value in weights.items():
        joint = _IN_PROJECTION.match(name)
        if name == "text_projection":
            named["text_projection.weight"] = value.T
        elif joint:
            for letter, part in zip("qkv", value.chunk(3), strict=True):
                named[f"{prefix}encoder.layers.{joint[1]}.self_attn.{letter}_proj.{joint[2]}"] = part
        else:
            for pattern, replacement in _RENAMED:
                name = re.sub(pattern, replacement, name)
            named[f"{prefix}{name}"] = value
    return named


def _load_tokenizer(source: str | Path, revision: str) -> Any:
    from transformers import CLIPTokenizer

    folder = Path(source).expanduser()
    try:
        if not folder.is_dir():
            return CLIPTokenizer.from_pretrained(str(source), revision=revision, local_files_only=True)
        if not any((folder / name).is_file() for name in ("vocab.json", "tokenizer.json")):
            raise OSError("the folder holds no vocab.json")
        return CLIPTokenizer.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError, TypeError) as error:
        what = f"{WHAT}: the tokeniser {str(source)!r} cannot be loaded ({str(error).splitlines()[0]})"
        raise ConfigError(f"{what}; {_GET_TOKENIZER}") from None


def _digest(weights: Mapping[str, Tensor]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(weights):
        digest.update(name.encode())
        digest.update(weights[name].detach().cpu().float().contiguous().numpy().data)
    return digest.hexdigest()
