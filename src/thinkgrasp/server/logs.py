"""Logs as one JSON object a line on stderr, without paths, keys, images or what people said."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import TextIO

from thinkgrasp.server.workers import where_raised

EVENTS = logging.getLogger("thinkgrasp.server")


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
            "event": record.getMessage() if own else str(record.msg).splitlines()[0][:200],
        }
        if not own:
            line["logger"] = record.name
        line |= getattr(record, "fields", {})
        if record.exc_info and record.exc_info[1] is not None:
            line["error"] = where_raised(record.exc_info[1])
        return json.dumps(line, ensure_ascii=True)


def set_up(out: TextIO = sys.stderr, *, level: int = logging.INFO) -> None:
    """Send the events of the server and of uvicorn to a stream, once."""
    handler = logging.StreamHandler(out)
    handler.setFormatter(JsonLines())
    for name, least in ((EVENTS.name, level), ("uvicorn", max(level, logging.WARNING))):
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.setLevel(least)
        logger.propagate = False
