"""The person beside the robot, who is asked before anything moves."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Literal, Protocol, TextIO

Answer = Literal["yes", "no", "stop"]


@dataclass(frozen=True)
class Motion:
    """What is about to move, for the person who is asked."""

    name: str
    detail: str


class Person(Protocol):
    """Answers before each motion."""

    def allows(self, motion: Motion) -> Answer:
        """Say whether this motion may be made: "no" refuses it, "stop" ends the run."""
        ...

    def confirms(self, question: str) -> bool:
        """Answer a question on which silence means no."""
        ...

    def tell(self, line: str) -> None:
        """Be told something."""
        ...


class AtTheKeyboard:
    """Asks on a terminal; the end of the input, or anything but a clear yes, is a no.

    What was typed before a question was there is no answer to it, and is thrown away.

    Args:
        answers: Where answers come from, a line each.
        questions: Where questions go.
    """

    def __init__(self, answers: TextIO | None = None, questions: TextIO | None = None) -> None:
        self._answers = answers
        self._questions = questions

    def allows(self, motion: Motion) -> Answer:
        """Ask for one motion: y(es), n(o), s(top)."""
        reply = self._ask(f"MOVE {motion.name}: {motion.detail}. Go? [y = yes, n = no, s = stop] ")
        if reply in ("y", "yes"):
            return "yes"
        return "stop" if reply in ("s", "stop", "q", "quit", None) else "no"

    def confirms(self, question: str) -> bool:
        """Ask a question: y(es) or no."""
        return self._ask(f"{question} [y/N] ") in ("y", "yes")

    def tell(self, line: str) -> None:
        """Print a line."""
        print(line, file=self._questions or sys.stderr, flush=True)

    def _ask(self, text: str) -> str | None:
        answers: TextIO | None = self._answers or sys.stdin  # None where a program was started without an input
        if answers is not None:
            _forget_what_was_typed(answers)
        print(text, end="", file=self._questions or sys.stderr, flush=True)
        try:
            line = answers.readline() if answers is not None else ""
        except UnicodeDecodeError:
            return ""
        except KeyboardInterrupt:
            print(file=self._questions or sys.stderr, flush=True)
            raise
        except (OSError, ValueError):  # hung up, or closed
            line = ""
        if not line:
            print("(no answer: the input has ended)", file=self._questions or sys.stderr, flush=True)
        return line.strip().lower() if line else None


def _forget_what_was_typed(answers: TextIO) -> None:
    try:
        import termios

        if answers.isatty():
            termios.tcflush(answers.fileno(), termios.TCIFLUSH)
    except (ImportError, AttributeError, OSError, ValueError):
        return  # no terminal, or none that can be emptied


class Absent:
    """Nobody is asked: motions go ahead, and every question is answered with no."""

    def __init__(self, out: TextIO | None = None) -> None:
        self._out = out

    def allows(self, motion: Motion) -> Answer:
        """Let it go ahead, and say so."""
        self.tell(f"MOVE {motion.name}: {motion.detail}")
        return "yes"

    def confirms(self, question: str) -> bool:
        """Answer no."""
        self.tell(f"{question} (nobody is asked: no)")
        return False

    def tell(self, line: str) -> None:
        """Print a line."""
        print(line, file=self._out or sys.stderr, flush=True)
