"""Answers of a server on file: recorded beside the questions, and replayed without a network.

A cassette is a text file of JSON lines: a header; each image once, named by its digest; and one line per question with
its digest, what was asked, and the answer or why there was none. It holds no key and no address.
"""

from __future__ import annotations

import base64
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any, cast

from thinkgrasp.errors import ConfigError
from thinkgrasp.planners.vlm.chat import Answer, Chat, Question, Unanswered
from thinkgrasp.types import Degradation

SCHEMA = "thinkgrasp/cassette-1"

Outcome = Answer | Unanswered


class Recording:
    """Asks another chat and keeps what comes, at the end of a file.

    Args:
        chat: What is asked.
        path: File to write; a cassette that is already there grows. One process may write to it at a time.

    Raises:
        ConfigError: The file cannot be written, or is there and no cassette.
    """

    def __init__(self, chat: Chat, path: str | Path) -> None:
        self._chat = chat
        self._path = Path(path)
        self._images: set[str] = set()
        try:
            old = self._path.is_file() and self._path.stat().st_size > 0
            if old:
                self._images = {cast(str, line["image"]) for line in _lines(self._path) if "image" in line}
            self._file: IO[str] = self._path.open("a", encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"cassette {str(path)!r} cannot be written: {error}") from error
        if not old:
            self._write({"schema": SCHEMA})

    def close(self) -> None:
        """Close the file and what is asked."""
        self._file.close()
        self._chat.close()

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()

    def ask(self, question: Question, deadline: float) -> Answer:
        """Return the answer, once it is on file.

        Raises:
            Unanswered: As the chat that is asked; that is kept too.
            ConfigError: The file can no longer be written.
        """
        try:
            answer = self._chat.ask(question, deadline)
        except Unanswered as failure:
            self._keep(question, failure)
            raise
        self._keep(question, answer)
        return answer

    def _keep(self, question: Question, outcome: Outcome) -> None:
        if question.image_digest not in self._images:
            self._write({"image": question.image_digest, "jpeg": base64.b64encode(question.jpeg).decode()})
            self._images.add(question.image_digest)
        asked = question.summary()
        if isinstance(outcome, Unanswered):
            spent = {"requests": outcome.requests, "latency_s": outcome.latency_s}
            told = {"failure": {"reason": outcome.reason, **spent}}
        else:
            told = {"answer": asdict(outcome)}
        self._write({"question": question.digest, "asked": asked, **told})

    def _write(self, line: dict[str, object]) -> None:
        try:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        except (OSError, ValueError) as error:
            raise ConfigError(f"cassette {str(self._path)!r} cannot be written: {error}") from error


class Replay:
    """Answers from a cassette. A question that was asked several times gets its answers in turn, then the last again.

    Args:
        path: What `Recording` wrote.

    Raises:
        ConfigError: The file cannot be read or is no cassette.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._outcomes: dict[str, list[Outcome]] = {}
        for line in _lines(self._path):
            if "question" in line:
                try:
                    self._outcomes.setdefault(cast(str, line["question"]), []).append(_outcome(line))
                except (KeyError, TypeError, ValueError) as error:
                    raise ConfigError(
                        f"cassette {str(path)!r} holds a line that is not understood: {error!r}"
                    ) from None

    def close(self) -> None:
        """Nothing is open."""

    def ask(self, question: Question, deadline: float) -> Answer:
        """Return the recorded answer.

        Raises:
            Unanswered: That is what was recorded.
            ConfigError: The question is not on the cassette.
        """
        outcomes = self._outcomes.get(question.digest)
        if outcomes is None:
            raise ConfigError(
                f"cassette {str(self._path)!r} does not hold the request {question.digest}; it was recorded with "
                "another scene, instruction, model or prompt, so record it anew"
            )
        outcome = outcomes.pop(0) if len(outcomes) > 1 else outcomes[0]
        if isinstance(outcome, Unanswered):
            raise Unanswered(outcome.reason, requests=outcome.requests, latency_s=outcome.latency_s)
        return outcome


def _lines(path: Path) -> list[dict[str, object]]:
    """Read a cassette's lines; a last one that was not written to its end is left out."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cassette {str(path)!r} cannot be read: {error}") from error
    complete = text[: text.rfind("\n") + 1]
    lines: list[dict[str, object]] = []
    for number, line in enumerate(complete.splitlines(), start=1):
        try:
            value: object = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"cassette {str(path)!r}, line {number} is not JSON: {error}") from None
        if not isinstance(value, dict):
            raise ConfigError(f"cassette {str(path)!r}, line {number} must be a JSON object")
        lines.append(cast(dict[str, object], value))
    schema = lines[0].get("schema") if lines else None
    if schema != SCHEMA:
        raise ConfigError(f"{str(path)!r} is no cassette: its first line says schema {schema!r}, not {SCHEMA!r}")
    return lines[1:]


def _outcome(line: dict[str, object]) -> Outcome:
    if "failure" in line:
        failure = cast(dict[str, Any], line["failure"])
        return Unanswered(failure["reason"], requests=failure["requests"], latency_s=failure["latency_s"])
    answer = cast(dict[str, Any], line["answer"])
    notes = tuple(Degradation(**note) for note in answer["notes"])
    return replace(Answer(**answer), notes=notes)
