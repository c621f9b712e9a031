"""Which weights exist, where they are on this machine, and the command that gets those that are missing.

Nothing is downloaded by this package: models are read from a folder or from the hub's cache, and what is not there is
an error that names the command.
"""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from thinkgrasp.errors import ConfigError

_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+(?:@[\w.-]+)?")
_COMMIT = re.compile(r"[0-9a-f]{40}")
DOWNLOADED = ("*.json", "*.txt", "*.safetensors")
"""What is fetched of a hub model: not the same weights again in other formats."""


@dataclass(frozen=True)
class KnownWeights:
    """One entry of weights.toml; fields as explained there."""

    name: str
    purpose: str
    licence: str
    hub: str | None = None
    revision: str | None = None
    gated: bool = False
    file: str | None = None
    url: str | None = None
    drive: str | None = None
    page: str | None = None
    sha256: str | None = None
    mb: int | None = None
    note: str | None = None

    @property
    def command(self) -> str:
        """The line that gets it; for a page without a direct link, what to do there."""
        if self.hub is not None:
            return ("hf auth login && " if self.gated else "") + download_command(self.hub, self.revision)
        path = files_folder() / (self.file or self.name)
        if self.url is not None:
            return f"curl --create-dirs -L -o '{path}' '{self.url}'"
        if self.drive is not None:
            return f"pip install gdown && mkdir -p '{path.parent}' && gdown {self.drive} -O '{path}'"
        return f"open {self.page} and save the checkpoint as {path}"

    def find(self) -> Path | None:
        """Return the folder (hub models) or file on this machine, or None.

        A hub model is looked for in the hub's cache, and as a folder of its name among the files.
        """
        path = files_folder() / (self.file or self.name)
        if self.hub is None:
            return path if path.is_file() else None
        complete = (path / "config.json").is_file() and weight_files(path)
        return cached_snapshot(self.hub, self.revision) or (path if complete else None)

    def intact(self, path: Path) -> bool:
        """Whether a file is the one that is known, where its digest is."""
        if self.sha256 is None:
            return True
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == self.sha256


@cache
def known_weights() -> Mapping[str, KnownWeights]:
    """Return all entries of weights.toml by name."""
    text = resources.files(__package__ or "").joinpath("weights.toml").read_text(encoding="utf-8")
    entries: dict[str, dict[str, Any]] = tomllib.loads(text)
    return {name: KnownWeights(name, **entry) for name, entry in entries.items()}


def locate_model(source: str | Path, *, what: str) -> Path:
    """Return the folder of a model on this machine; nothing is downloaded.

    Args:
        source: A folder with config.json and weights; a name of weights.toml ("sam-vit-base"); or a hub id, with the
            commit as "owner/name@commit" or else as weights.toml pins it.
        what: What the model is for, as errors call it.

    Raises:
        ConfigError: It is none of these, or not on this machine; the message holds the command that gets it.
    """
    text = str(source)
    folder = Path(source).expanduser()
    if folder.is_dir():
        if not (folder / "config.json").is_file():
            raise ConfigError(f"{what}: {folder} is no model folder: it holds no config.json (see save_pretrained)")
        return folder
    if folder.is_file():
        raise ConfigError(f"{what}: {folder} is a file; give the folder that holds config.json and the weights")
    known = known_weights().get(text)
    if known is None and (isinstance(source, Path) or not _HUB_ID.fullmatch(text)):
        names = ", ".join(name for name, entry in known_weights().items() if entry.hub)
        raise ConfigError(
            f"{what}: there is no folder {text}, and no model of that name; known: {names}; or OWNER/NAME"
        )
    if known is not None and known.hub is None:
        raise ConfigError(f"{what}: {text} is a single file and no model folder ({known.purpose})")
    hub, revision = (known.hub or "", known.revision) if known is not None else _split(text)
    if revision is None or not _COMMIT.fullmatch(revision):
        warnings.warn(
            f"{what}: {hub} is not pinned to a commit, so what it does may change; write {hub}@COMMIT", stacklevel=2
        )
    found = known.find() if known is not None else cached_snapshot(hub, revision)
    if found is None:
        entry = known or next((e for e in known_weights().values() if e.hub == hub and e.revision == revision), None)
        command = entry.command if entry is not None else download_command(hub, revision)
        raise ConfigError(
            f"{what}: {hub} is not on this machine (looked for {revision or 'its main revision'} in {hub_cache()}); "
            f"get it with: {command}; or give a local folder"
        )
    return found


def locate_file(source: str | Path | None, *, default: str, what: str) -> Path:
    """Return a file of weights; nothing is downloaded.

    Args:
        source: A path, which is not looked at here; a name of weights.toml; None = the default.
        default: A name of weights.toml.
        what: What the weights are for, as errors call it.

    Raises:
        ConfigError: A known file is not on this machine; the message holds its licence and the command that gets it.
    """
    known = known_weights().get(default if source is None else str(source))
    if known is None or known.file is None:
        return Path(source or default).expanduser()
    found = known.find()
    if found is None:
        raise ConfigError(
            f"{what}: {known.file} is not on this machine (licence: {known.licence}); get it with: {known.command}; or "
            "give its path, for a generator with --weights FILE"
        )
    return found


def _split(hub_id: str) -> tuple[str, str | None]:
    hub, _, revision = hub_id.partition("@")
    pinned = next((e.revision for e in known_weights().values() if e.hub == hub), None)
    return hub, revision or pinned


def download_command(hub: str, revision: str | None) -> str:
    """Return the command that puts a hub model into the hub's cache."""
    pinned = f" --revision {revision}" if revision else ""
    return f"hf download {hub}{pinned} " + " ".join(f"--include '{pattern}'" for pattern in DOWNLOADED)


def cached_snapshot(hub: str, revision: str | None) -> Path | None:
    """Return a model's folder in the hub's cache, or None where its configuration or its weights are not there."""
    folder = hub_cache() / f"models--{hub.replace('/', '--')}"
    name = revision or "main"
    if not _COMMIT.fullmatch(name):
        ref = folder / "refs" / name
        if not ref.is_file():
            return None
        name = ref.read_text(encoding="utf-8").strip()
    snapshot = folder / "snapshots" / name
    complete = (snapshot / "config.json").is_file() and weight_files(snapshot)
    return snapshot if complete else None


def weight_files(folder: Path) -> list[Path]:
    """Return the weights that `from_pretrained` would read from a folder; safetensors before pickles."""
    for pattern in ("model*.safetensors", "pytorch_model*.bin"):
        found = sorted(path for path in folder.glob(pattern) if path.is_file())
        if found:
            return found
    return []


def hub_cache() -> Path:
    """Return the folder of the Hugging Face hub's cache, which need not exist."""
    for variable in ("HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE"):
        if os.environ.get(variable):
            return Path(os.environ[variable]).expanduser()
    home = os.environ.get("HF_HOME")
    return (Path(home).expanduser() if home else _caches() / "huggingface") / "hub"


def files_folder() -> Path:
    """Return the folder for weights by name: THINKGRASP_WEIGHTS, or one in the user's cache."""
    chosen = os.environ.get("THINKGRASP_WEIGHTS")
    return Path(chosen).expanduser() if chosen else _caches() / "thinkgrasp" / "weights"


def _caches() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
