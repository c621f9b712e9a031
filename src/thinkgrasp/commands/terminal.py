"""What commands share with whoever calls them: exit codes, and lines that any terminal can show."""

from __future__ import annotations

import sys

from thinkgrasp.errors import InputError
from thinkgrasp.outputs import one_line

DONE, NOTHING, BAD_INPUT, BUG, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit codes: done; nothing found; bad input or configuration; a bug; interrupted."""


def progress(text: str) -> None:
    """Print a line to stderr, which leaves stdout to the answer."""
    print(one_line(text), file=sys.stderr, flush=True)


def encodable(text: str) -> str:
    """Return JSON text as it is, or with escapes where stdout's encoding lacks a character."""
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        import json

        return json.dumps(json.loads(text), indent=2)
    return text


def check_text(instruction: str) -> str:
    """Return an instruction without surrounding space; InputError where it is empty, too long, or no valid text."""
    from thinkgrasp.pipeline import check_instruction

    instruction = check_instruction(instruction)
    try:
        instruction.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"the instruction is no valid text: {error}") from error
    return instruction
