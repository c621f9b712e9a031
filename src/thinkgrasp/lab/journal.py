"""What a robot was about to do, what was answered, and what became of it: one JSON line each, on the disk at once."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

from thinkgrasp.errors import InputError


class Journal:
    """Appends to a file; lines are durable when `note` returns.

    Args:
        path: File to append to; None keeps lines in memory only.

    Raises:
        InputError: The file cannot be written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self.lines: list[dict[str, object]] = []
        if path is not None:
            self._write("")

    def note(self, event: str, **values: object) -> None:
        """Keep one event with its values."""
        line: dict[str, object] = {"time": round(time.time(), 3), "event": event, **values}
        self.lines.append(line)
        if self._path is not None:
            self._write(json.dumps(line, default=str) + "\n")

    def _write(self, text: str) -> None:
        assert self._path is not None  # both callers look
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"the robot's log {self._path} cannot be written: {error.strerror or error}") from error
