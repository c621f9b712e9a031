"""Turn a model's reply into a plan: pure, and never anything but a plan or a PlanParseError."""

from __future__ import annotations

import re

from thinkgrasp.planners.reply_json import read_json
from thinkgrasp.planners.reply_text import read_labels, read_unlabelled, undecorated
from thinkgrasp.planners.reply_values import (
    MAX_RATIONALE_CHARS,
    Entry,
    PlanParseError,
    Reply,
    Target,
    is_nothing,
    plain,
    quote,
    read_box,
    read_cell,
    read_mark,
    read_pixel,
    read_score,
    read_target,
)
from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Plan, PlanKind, PlannedObject, Role

__all__ = ["PlanParseError", "parse_reply"]

MAX_REPLY_CHARS = 50_000
"""What comes after is not read: a plan is short, and a model that loops writes without end."""

_THOUGHT_ENDS = re.compile(r"</(?:think|thinking|reasoning)>", re.IGNORECASE)
_THOUGHT_BEGINS = re.compile(r"<(?:think|thinking|reasoning)>", re.IGNORECASE)
_REFUSAL = re.compile(
    r"\b(?:sorry|apologi[sz]e|(?:can(?:no|')?t|cannot|can not|won't|unable to|not able to)\s+(?:\w+\s+)?"
    r"(?:help|assist|comply|fulfil|provide|process|identify|do|see|view))",
    re.IGNORECASE,
)
_NO = re.compile(r"(?:no|not|false|hidden|0)\b", re.IGNORECASE)


def parse_reply(text: str, *, grid: int = 3, image_wh: tuple[int, int]) -> Plan:
    """Turn a reply, in JSON or in labelled lines, into a plan.

    The first JSON object that names a target counts, else the first line that does, else an "[object: ...]", the only
    object described, or the only mark spoken of. What a cut-off reply holds in full
    is used: a plan needs a target, and without a cell its middle is taken.

    Args:
        text: The reply as the model wrote it.
        grid: Cells per side of the target's box, at least 1.
        image_wh: Size of the image that the model saw [px]; boxes are clipped to it.

    Returns:
        The plan, with boxes in pixels of that image; `found` is False where the model says that nothing is worth
        taking.

    Raises:
        PlanParseError: The reply is empty, refuses, names no target, or holds a cell, mark or box that is out of range
            or cannot be read.
    """
    answer = _answer(text or "")
    readable = undecorated(answer)
    reply = read_json(answer) or read_json(readable) or read_labels(readable)
    if reply is None and not _refuses(answer):
        reply = read_unlabelled(readable)
    if reply is None:
        raise PlanParseError(_why_no_plan(text or "", answer))
    target = read_target(reply.target)
    mark = read_mark(reply.mark or target.mark)
    visible = not _NO.match(reply.visible)
    if mark is None and (not target.name or is_nothing(target.name)):
        if not target.name and (visible or not reply.visible):
            raise PlanParseError(f"the reply names no target: {quote(answer)}")
        return Plan(
            "", _rationale(reply), grid=grid, cell=middle_cell(grid), objects=_objects(reply, grid), found=False
        )
    if not target.name or is_nothing(target.name):
        target = Target(f"mark {mark}", target.kind, "")
    return Plan(
        target=target.name,
        rationale=_rationale(reply),
        role=_role(reply.role, visible=visible),
        kind=_kind(reply.kind, target.kind),
        mark=mark,
        grid=grid,
        cell=_cell(reply, target.name, mark, grid),
        crop_xyxy=read_box(reply.box, image_wh),
        point_px=read_pixel(reply.pixel, image_wh),
        objects=_objects(reply, grid),
    )


def _answer(text: str) -> str:
    """Return what a model wrote after thinking aloud, at most MAX_REPLY_CHARS of it."""
    spoken = _THOUGHT_ENDS.split(text)[-1]
    return _THOUGHT_BEGINS.split(spoken, maxsplit=1)[0][:MAX_REPLY_CHARS]


def _why_no_plan(text: str, answer: str) -> str:
    if not plain(answer):
        return "the reply is empty" + (": the model was cut off while it was thinking" if plain(text) else "")
    if _refuses(answer):
        return f"the model refuses: {quote(answer)}"
    return f"the reply names no target, neither as JSON nor in a line 'Selected object: ...': {quote(answer)}"


def _refuses(answer: str) -> bool:
    return _REFUSAL.search(answer.replace("’", "'")[:2000]) is not None


def _rationale(reply: Reply) -> str:
    return plain(reply.rationale)[:MAX_RATIONALE_CHARS]


def _role(text: str, *, visible: bool) -> Role:
    """Return the role; a thing that is taken while the goal is not seen is in the goal's way."""
    return (
        "obstruction"
        if not visible or re.match(r"obst|obsc|block|clear|remov", text.strip(" '\"[(").lower())
        else "goal"
    )


def _kind(text: str, of_name: PlanKind) -> PlanKind:
    return (
        "part" if of_name == "part" or re.match(r"(?:object[\s_-]*)?part", text.strip(" '\"[(").lower()) else "object"
    )


def _cell(reply: Reply, target: str, mark: int | None, grid: int) -> int:
    """Return the plan's cell: its own, else that of the listed object that is the target, else the middle."""
    text = reply.cell
    if not text:
        entry = _entry_of(reply.entries, target, mark)
        text = entry.cell if entry is not None else ""
    cell = read_cell(text, grid) if text else None
    return cell if cell is not None else middle_cell(grid)


def _entry_of(entries: tuple[Entry, ...], target: str, mark: int | None) -> Entry | None:
    with_cell = [e for e in entries if e.cell]
    by_mark = [e for e in with_cell if mark is not None and e.mark.strip() == str(mark)]
    words = _words(target)
    same = [e for e in with_cell if _words(e.name) == words]
    akin = [e for e in with_cell if (of := _words(e.name)) and (of <= words or words <= of)]
    only = with_cell if len(with_cell) == 1 else []
    return next(iter([*by_mark, *same, *akin, *only]), None)


def _words(name: str) -> set[str]:
    return set(re.findall(r"\w+", read_target(name).name.lower().replace("_", " ")))


def _objects(reply: Reply, grid: int) -> tuple[PlannedObject, ...]:
    """Return the listed objects that have a name and a score, each once."""
    listed: list[PlannedObject] = []
    for entry in reply.entries:
        name, score = read_target(entry.name).name, read_score(entry.score)
        if name and score is not None:
            listed.append(PlannedObject(name, score, _listed_cell(entry.cell, grid)))
    return tuple(dict.fromkeys(listed))


def _listed_cell(text: str, grid: int) -> int | None:
    """Return a listed object's cell; None where it cannot be read, as it only informs."""
    try:
        return read_cell(text, grid) if text else None
    except PlanParseError:
        return None
