"""Load a model of the transformers library from a folder: safely, whole or not at all, and with errors that say why."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, cast

import torch
from torch import nn

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.networks.checkpoint import choose_device, ready
from thinkgrasp.networks.torch_install import CURE, torchvision_problem
from thinkgrasp.weights import locate_model, weight_files

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
MAX_TOLD = 4
"""So many names of missing tensors are told."""
_PACKAGES = ("transformers", "tokenizers", "safetensors", "huggingface_hub")


class ModelClass(Protocol):
    """A class of transformers' models."""

    def from_pretrained(self, folder: Path, **settings: Any) -> tuple[nn.Module, dict[str, Any]]:
        """Make a model and say what was not found."""
        ...


def import_models(load: Callable[[], Any], *, what: str) -> Any:
    """Return what `load` imports from transformers.

    Raises:
        MissingDependency: transformers is not installed.
        ConfigError: It is, and cannot be imported, most likely for torchvision's sake.
    """
    try:
        return load()
    except (ImportError, RuntimeError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name in _PACKAGES:
            raise MissingDependency(error.name, "langsam", what) from None
        problem = torchvision_problem()
        if problem is None:
            raise
        raise ConfigError(f"{what}: {problem}. {CURE}") from error


def model_type(folder: Path, *, what: str) -> str:
    """Return the kind of model that a folder holds, as its config.json calls it.

    Raises:
        ConfigError: config.json cannot be read or names no kind.
    """
    path = folder / "config.json"
    try:
        config: object = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{what}: {path} cannot be read: {error}") from None
    kind = cast(dict[str, object], config).get("model_type") if isinstance(config, dict) else None
    if not isinstance(kind, str):
        raise ConfigError(f"{what}: {path} names no model_type, so it is no model of the transformers library")
    return kind


def find_model(source: str | Path, kinds: Collection[str], *, what: str) -> Path:
    """Return the folder of a model of one of these kinds.

    Raises:
        ConfigError: It is not on this machine, is of another kind, or has no weights.
    """
    folder = locate_model(source, what=what)
    kind = model_type(folder, what=what)
    if kind not in kinds:
        raise ConfigError(f"{what}: {folder} holds a {kind!r} model; allowed: {', '.join(sorted(kinds))}")
    if not weight_files(folder):
        raise ConfigError(f"{what}: {folder} holds a config.json but no weights (model.safetensors)")
    return folder


def load_model(
    cls: ModelClass, folder: Path, *, what: str, device: str | None = None, dtype: str | None = None
) -> nn.Module:
    """Return a model ready to run: on its device, in evaluation mode, without gradients.

    Args:
        cls: Its class.
        folder: Where it lies; safetensors are read, or else pickles with torch's `weights_only`.
        what: What it is for, as errors call it.
        device: "cpu", "cuda", "cuda:1", ...; None = a CUDA device where there is one.
        dtype: A name of DTYPES; None = float32.

    Raises:
        ConfigError: The device or dtype is not there, or the weights cannot be read or are not all there.
    """
    if dtype is not None and dtype not in DTYPES:
        raise ConfigError(f"{what}: dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    place = choose_device(device, what=what)
    safe = weight_files(folder)[0].suffix == ".safetensors"
    try:
        with _quiet():
            model, info = cls.from_pretrained(
                folder,
                local_files_only=True,
                trust_remote_code=False,
                use_safetensors=safe,
                weights_only=True,
                dtype=DTYPES[dtype or "float32"],
                output_loading_info=True,
            )
    except Exception as error:  # the library raises whatever its readers do; all of it means these files
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{what}: the model in {folder} cannot be loaded: {reason}") from error
    missing = sorted(map(str, info["missing_keys"]))
    if missing:
        some = ", ".join(missing[:MAX_TOLD]) + (", ..." if len(missing) > MAX_TOLD else "")
        raise ConfigError(f"{what}: the weights in {folder} lack {len(missing)} tensors ({some})")
    return ready(model, place)


def load_tokenizer(folder: Path, *, what: str) -> Any:
    """Return the tokenizer that lies beside a model.

    Raises:
        ConfigError: There is none, or one that does not say where its tokens stand in the text.
    """
    from transformers import AutoTokenizer

    try:
        with _quiet():
            tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{what}: the tokenizer in {folder} cannot be loaded: {reason}") from error
    if not tokenizer.is_fast or len(tokenizer) < 100:
        raise ConfigError(f"{what}: {folder} holds no tokenizer (tokenizer.json)")
    return tokenizer


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the library from writing bars and advice to stderr."""
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
