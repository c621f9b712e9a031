"""The tensors of a TorchScript archive, read without running any of it.

OpenAI publishes CLIP as such archives (RN50.pt), which torch refuses to read with `weights_only`. The part of an
archive that names the tensors is a pickle; the reader here resolves nothing in it but tensors, numbers and inert
modules.

References:
    The zip format of torch.jit.save: data.pkl holds the module tree, data/<key> the bytes of each storage.
"""

from __future__ import annotations

import pickle
import sys
import zipfile
from collections import OrderedDict
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from thinkgrasp.errors import ConfigError

_DTYPES = {
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "DoubleStorage": torch.float64,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "BoolStorage": torch.bool,
}


def is_torchscript(path: Path) -> bool:
    """Return whether a file is a TorchScript archive."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def read_torchscript(path: Path, *, what: str) -> dict[str, Tensor]:
    """Return the parameters and buffers of an archive by dotted name, on the CPU.

    Args:
        path: A file written by torch.jit.save.
        what: What the weights are for, as errors call it.

    Raises:
        ConfigError: The archive is damaged, or holds something else than modules, tensors and plain values.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            (listing,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
            root = _Reader(archive, listing.removesuffix("data.pkl")).load()
    except (pickle.UnpicklingError, zipfile.BadZipFile, OSError) as error:
        raise ConfigError(f"{what}: {path} cannot be read as a TorchScript archive: {error}") from None
    except (KeyError, ValueError, TypeError, IndexError, EOFError, AttributeError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ConfigError(f"{what}: the TorchScript archive {path} is damaged ({reason})") from None
    return dict(_tensors(root, ""))


class _Module:
    """Stands for every class of the archive: it keeps attributes and does nothing."""

    def __init__(self, *_: object) -> None:
        self.attributes: dict[str, object] = {}

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            self.attributes = state


class _Storage(NamedTuple):
    key: str
    dtype: torch.dtype
    numbers: int


class _Reader(pickle.Unpickler):
    """Resolves the names that describe tensors; every other name is refused."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder
        self._loaded: dict[str, Tensor] = {}

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "__torch__":
            return _Module
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch.jit._pickle" and name.startswith("build_"):
            return list
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no part of a tensor")

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, torch.dtype):
            raise pickle.UnpicklingError(f"unknown kind of data {kind!r}")
        return _Storage(str(key), dtype, int(count))

    def _tensor(self, storage: _Storage, offset: int, size: Any, stride: Any, *_: object) -> Tensor:
        if storage.key not in self._loaded:
            data = bytearray(self._archive.read(f"{self._folder}data/{storage.key}"))
            if self._big_endian() or len(data) != storage.numbers * storage.dtype.itemsize:
                raise pickle.UnpicklingError(f"storage {storage.key} has another size or byte order than it says")
            empty = torch.empty(0, dtype=storage.dtype)
            self._loaded[storage.key] = torch.frombuffer(data, dtype=storage.dtype) if data else empty
        return self._loaded[storage.key].as_strided(tuple(size), tuple(stride), offset)

    def _big_endian(self) -> bool:
        name = f"{self._folder}byteorder"
        order = self._archive.read(name).decode() if name in self._archive.namelist() else "little"
        return order.strip() != sys.byteorder


def _tensors(node: object, name: str) -> list[tuple[str, Tensor]]:
    if isinstance(node, Tensor):
        return [(name, node)]
    if not isinstance(node, _Module):
        return []
    prefix = f"{name}." if name else ""
    return [pair for key, value in node.attributes.items() for pair in _tensors(value, f"{prefix}{key}")]
