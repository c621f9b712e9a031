"""Read a file of weights safely, and load it into a module whole or not at all."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from thinkgrasp.errors import ConfigError, MissingDependency

NetworkT = TypeVar("NetworkT", bound=nn.Module)
WRAPPERS = ("model_state_dict", "state_dict", "model")
"""Under one of these a training script stores its weights, beside what else it keeps."""
MAX_TOLD = 4
"""So many names are told of each kind of difference."""


def read_checkpoint(path: str | Path, *, what: str) -> dict[str, Tensor]:
    """Return the tensors of a file by name, on the CPU.

    Nothing of a file is executed: it is a .safetensors file, or torch reads it with `weights_only`.

    Args:
        path: A file written by torch.save or by safetensors; weights may stand under a key of WRAPPERS.
        what: What the weights are for, as errors call it.

    Raises:
        ConfigError: There is no such file, it is not a file of weights, or reading it would run code.
        MissingDependency: It is a .safetensors file and the package safetensors is not installed.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        state = "is a folder" if path.is_dir() else "does not exist"
        raise ConfigError(f"{what}: the weights file {path} {state}; give the path of the checkpoint itself")
    content = _safetensors(path, what) if path.suffix == ".safetensors" else _torch_file(path, what)
    for key in WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = cast(object, content[key])
    tensors: dict[str, Tensor] = {}
    if isinstance(content, dict):
        entries = cast(dict[object, object], content)
        tensors = {str(name): value for name, value in entries.items() if isinstance(value, Tensor)}
    if not tensors:
        raise ConfigError(f"{what}: {path} holds no named tensors, so it is not a checkpoint")
    if all(name.startswith("module.") for name in tensors):
        tensors = {name.removeprefix("module."): value for name, value in tensors.items()}
    return tensors


def load_strictly(
    module: nn.Module,
    weights: Mapping[str, Tensor],
    *,
    what: str,
    optional: Collection[str] = (),
    assign: bool = False,
) -> tuple[str, ...]:
    """Copy weights into a module, float tensors in the module's own dtype.

    Args:
        module: Every one of its parameters and buffers must be among the weights, except `optional` ones.
        weights: By name.
        what: What the module is, as errors call it.
        optional: Names in the module that a file may lack.
        assign: Take the tensors themselves, in their own dtype, instead of copying them; for a module on the meta
            device, so that nothing is held twice.

    Returns:
        The names in `weights` that the module has no place for.

    Raises:
        ConfigError: Names are missing or shapes differ; the module is unchanged.
    """
    own = module.state_dict()
    missing = [name for name in own if name not in weights and name not in optional]
    misshapen = [
        f"{name} is {tuple(weights[name].shape)} instead of {tuple(value.shape)}"
        for name, value in own.items()
        if name in weights and weights[name].shape != value.shape
    ]
    unused = tuple(name for name in weights if name not in own)
    if missing or misshapen:
        parts = [f"{len(missing)} of {len(own)} tensors are missing ({_some(missing)})"] if missing else []
        parts += [f"{len(misshapen)} have another shape ({_some(misshapen)})"] if misshapen else []
        parts += [f"{len(unused)} are unknown ({_some(unused)})"] if unused else []
        raise ConfigError(f"{what}: these are weights of another model: {'; '.join(parts)}")
    own_weights = {name: weights[name] for name in own if name in weights}
    module.load_state_dict(own_weights, strict=not optional, assign=assign)
    return unused


def ready(network: NetworkT, device: torch.device | str, dtype: torch.dtype | None = None) -> NetworkT:
    """Move a network to its device, for inference alone.

    On CUDA the convolutions of this process then calculate in float32 and not in TF32, whose 10 bits give other boxes
    and scores than a CPU does; who wants speed gives a smaller dtype.
    """
    if torch.device(device).type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
    return network.eval().requires_grad_(False).to(device=device, dtype=dtype)


def choose_device(device: str | None, *, what: str) -> torch.device:
    """Return the device of that name; None = a CUDA device where there is one, else the CPU.

    Raises:
        ConfigError: There is no such device here.
    """
    if device is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(device)
        torch.empty(0, device=chosen)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{what}: device {device!r} cannot be used here ({reason}); use 'cpu' or 'cuda'") from None
    return chosen


def _torch_file(path: Path, what: str) -> object:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a protocol that torch may not know: it says so when it does not
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ConfigError(
            f"{what}: {path} is not a plain file of weights, and reading it otherwise could run code: "
            f"{str(error).splitlines()[0]}; save its state_dict alone with torch.save"
        ) from None
    except (OSError, RuntimeError, EOFError, ValueError, KeyError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{what}: {path} cannot be read as weights: {reason}") from None


def _safetensors(path: Path, what: str) -> object:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ModuleNotFoundError:
        raise MissingDependency("safetensors", "langsam", f"{what}: reading {path.name}") from None
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{what}: {path} cannot be read as weights: {error}") from None


def _some(names: Collection[str]) -> str:
    told = list(names)[:MAX_TOLD]
    return ", ".join(told) + (", ..." if len(names) > MAX_TOLD else "")
