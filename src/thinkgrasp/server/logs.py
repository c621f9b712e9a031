"""Logs as one JSON object a line on stderr, without paths, keys, images or what people said."""

from __future__ import annotations

import json
import logging
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from thinkgrasp.server.decoding import without_paths

EVENTS = logging.getLogger("thinkgrasp.server")
NOISY = ("python_multipart", "uvicorn")
"""Loggers that warn of what clients send wrong, which is in our own events."""


def log(event: str, *, level: int = logging.INFO, **fields: object) -> None:
    """Log one event; fields are numbers, booleans, and texts that the server itself chose."""
    EVENTS.log(level, event, extra={"fields": fields})


class JsonLines(logging.Formatter):
    """Formats our events with their fields, and other loggers' messages without their arguments or tracebacks."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line of JSON."""
        own = record.name == EVENTS.name
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage() if own else without_paths(str(record.msg).partition("\n")[0][:200]),
        }
        if not own:
            line["logger"] = record.name
        line |= getattr(record, "fields", {})
        if record.exc_info and record.exc_info[1] is not None:
            line["error"] = where_raised(record.exc_info[1])
        return json.dumps(line, ensure_ascii=True)


def where_raised(error: BaseException) -> str:
    """Return an exception's type and the file and line that raised it, without folders and without its message."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}{place}"


@contextmanager
def to_stream(out: TextIO, *, level: int = logging.INFO) -> Iterator[None]:
    """Send the server's events, and the warnings of all other loggers, to a stream while the block runs."""
    handler = logging.StreamHandler(out)
    handler.setFormatter(JsonLines())
    root = logging.getLogger()
    before = [(logger, logger.level) for logger in (root, EVENTS, *map(logging.getLogger, NOISY))]
    root.addHandler(handler)
    root.setLevel(logging.WARNING)
    EVENTS.setLevel(level)
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for logger, former in before:
            logger.setLevel(former)
