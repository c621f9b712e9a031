"""Is torchvision in torch's way? It is not needed, and transformers imports it wherever it is installed."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec

CURE = (
    "thinkgrasp needs no torchvision: pip uninstall -y torchvision; or, where something else needs it, install the "
    "pair that belongs together from one index, for a CPU: "
    "pip install --force-reinstall torch torchvision --index-url https://download.pytorch.org/whl/cpu"
)
_TIMEOUT_S = 120


def torchvision_problem() -> str | None:
    """Return what is wrong with an installed torchvision, in words; None where there is none or it is in order.

    Its version is held against torch's, and it is imported in a process of its own.
    """
    if find_spec("torchvision") is None or find_spec("torch") is None:
        return None
    own, torch = _version("torchvision"), _version("torch")
    pair = f"torchvision {own or 'of unknown version'} beside torch {torch or 'of unknown version'}"
    try:
        done = subprocess.run(
            [sys.executable, "-c", "import torchvision"],
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"{pair} is not imported within {_TIMEOUT_S} s"
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        return f"{pair} cannot be imported, which breaks transformers' models: {reason}"
    if own is None or torch is None:
        return None
    wanted = _wanted_torch()
    if wanted is not None and wanted != torch.partition("+")[0]:
        return f"{pair}, but it was built for torch {wanted}"
    builds = [text.partition("+")[2] for text in (own, torch)]
    if all(builds) and builds[0] != builds[1]:
        return f"{pair}: one is a build for {builds[0]}, the other for {builds[1]}"
    return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _wanted_torch() -> str | None:
    for line in requires("torchvision") or []:
        match = re.fullmatch(r"torch\s*\(?==\s*([\w.]+)\)?(?:\s*;.*)?", line.strip())
        if match:
            return match[1]
    return None
