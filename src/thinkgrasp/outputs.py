"""Files that a command writes: refused before the work when they cannot be written, complete or not there at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from thinkgrasp.errors import InputError

OVERLAY_SUFFIXES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP"}
"""What the annotated image can be written as, and Pillow's names for it."""


def check_writable(path: Path, what: str, *, inputs: Iterable[Path] = ()) -> None:
    """Raise InputError unless a file can be written at `path` and it is none of the inputs.

    The folder is tried by making and removing an empty file in it.
    """
    try:
        if path.is_dir():
            raise InputError(f"{what} {path} is a directory; give a file name")
        if not path.parent.is_dir():
            raise InputError(f"{what} {path} cannot be written: the directory {path.parent} does not exist")
        if _exists(path):
            for other in inputs:
                if other.exists() and path.samefile(other):
                    raise InputError(f"{what} {path} would overwrite an input file; choose another name")
            if not os.access(path, os.W_OK):
                raise InputError(f"{what} {path} cannot be written: it is write-protected")
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".thinkgrasp-"):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{what} {str(path)!r} cannot be written: {error}") from error


def make_folder(path: Path) -> None:
    """Make a folder with its parents, or raise InputError when it cannot be made or written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path, prefix=".thinkgrasp-"):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"output folder {str(path)!r} cannot be used: {error}") from error


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file so that readers see the old content or all of the new.

    Raises:
        InputError: It cannot be written.
    """
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".thinkgrasp-", suffix=path.suffix)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
        temporary = None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def _exists(path: Path) -> bool:
    """Like Path.exists, but names that no file can have raise."""
    try:
        path.stat()
    except FileNotFoundError:
        return False
    return True


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def one_line(text: object) -> str:
    """Return the text on one line, without control characters, at most 600 characters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    return line if len(line) <= 600 else f"{line[:597]}..."
