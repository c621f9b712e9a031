"""Read a reply in labelled lines, as in the published format, however it is decorated."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from thinkgrasp.planners.reply_values import MAX_NAME_CHARS, Entry, Reply, is_nothing, is_placeholder, plain

MAX_ENTRIES = 64
MAX_BEFORE_CHARS = 200

_PUNCTUATION = str.maketrans(
    {
        **dict.fromkeys("“”„‟«»″", '"'),
        **dict.fromkeys("‘’‚‛′", "'"),
        **dict.fromkeys("【〔〖「『［", "["),
        **dict.fromkeys("】〕〗」』］", "]"),
        **dict.fromkeys("–—−‐‑‒―", "-"),
        **dict.fromkeys("、،", ","),
        **dict.fromkeys("؛", ";"),
        **dict.fromkeys("。｡", "."),
        **dict.fromkeys("→⇒➜", ":"),
        "\r": "\n",
    }
)

_BULLET = re.compile(r"[\s>#*+\-•·▪◦●○|]*(?:\(?\d{1,2}[.)]\s+)?(?:[\s>#*+\-•·▪◦●○]+(?=\S))?")
_NOTE = r"(?:\s*\([^()\n]{0,60}\))?"
_SEP = rf"{_NOTE}\s*[\"']?\s*(?::+|=|\bis\b|-\s|$)\s*"
_NUMBER_SEP = rf"{_NOTE}\s*(?:(?::+|=|-\s|\bof\b|\bis\b|$)\s*|(?=[(\[<]?\s*[-+~]?\d))"
_OPEN_SEP = rf"{_NOTE}\s*[\"']?\s*(?::+|=|-\s|\bof\b|\bis\b)?\s*"
_LABELS = {
    "visible": rf"(?:(?:goal|target|object)[\s_]*)?(?:is[\s_]+)?visible{_NOTE}\s*[:=?]+\s*",
    "target": r"(?:(?:selected|chosen|picked|final|best)(?:[\s_-]*(?:target|object|item|part)s?)*"
    r"|target(?:[\s_-]*object)?|selection|object to (?:grasp|pick|take|move|remove)(?: up| first)?)"
    rf"(?:\s*(?:/|\bor\b|\band\b|&)\s*(?:target\s*)?(?:object[\s_-]*)?part)?{_SEP}",
    "header": r"objects\b[^:\n]{0,60}:",
    "box": r"(?:(?:^|(?<=[;,|])|(?<=[;,|]\s))box\s*[:=]\s*"
    r"|(?:crop(?:ping|ped)?[\s_-]*(?:box|region|area)?|bounding[\s_-]*box|bbox)(?:[\s_]*coordinates?)?"
    rf"(?:{_SEP}|\s+(?=[(\[\d])))",
    "pixel": rf"(?:grasp(?:ing)?[\s_-]*)?pixel(?:[\s_]*(?:coordinates?|position))?(?:{_SEP}|\s+(?=[(\[\d]))",
    "score": rf"(?:(?:grasp(?:ing|ability)?|success)[\s_-]*)?score\b{_NUMBER_SEP}"
    rf"|(?:graspability|ease of grasping){_SEP}",
    "cell": r"(?:(?:preferred|best|recommended|optimal|ideal)[\s_-]*(?:grasp(?:ing)?[\s_-]*)?"
    r"(?:grid[\s_-]*)?(?:location|cell|position|point|region)"
    r"|grasp(?:ing)?[\s_-]*(?:location|cell|position|point|region)"
    rf"|grid[\s_-]*(?:cell|location|position))(?:[\s_]*(?:number|no\.?))?\b{_OPEN_SEP}"
    r"|grid\s*[:=#]\s*"
    rf"|(?:cell|location)(?:[\s_]*(?:number|no\.?))?{_NOTE}\s*(?:[:=#]\s*|(?=\d))",
    "mark": r"mark(?:[\s_]*(?:number|id))?\s*[:=#]\s*",
    "role": r"role\s*[:=]\s*",
    "kind": r"(?:kind|type)\s*[:=]\s*",
    "rationale": r"(?:rationale|reason(?:ing)?|explanation|justification)\s*[:=]\s*",
    "other": r"(?:material(?:[\s_]+composition)?|surface(?:[\s_]+texture)?|texture|stability(?:[\s_]+assessment)?"
    r"|centroid(?:[\s_]+coordinates)?|colou?r|shape|size|importance|safety|confidence|notes?)\s*[:=]\s*",
    "object": r"(?:object|item)(?:[\s_]*name)?(?:\s*#?\d{1,2})?\s*[:=]\s*|name\s*[:=]\s*",
}
_LABEL = re.compile(
    r"(?<![\w/\"'])(?:" + "|".join(f"(?P<{kind}>{pattern})" for kind, pattern in _LABELS.items()) + ")", re.IGNORECASE
)
_TABLE_RULE = re.compile(r"\|?(?:\s*:?-+:?\s*\|)+(?:\s*:?-+:?)?\s*")
_LEAD_OUT = re.compile(r"[\s,;:|(\[-]*(?:\b(?:has|with|gets|had|and)\b(?:\s+an?)?)?[\s,;:|(\[-]*$", re.IGNORECASE)


class _Field(NamedTuple):
    """One labelled value; kind "line" is a line without a label."""

    kind: str
    value: str
    label: str = ""
    before: str = ""
    """What stands before the label on its line."""


def read_labels(text: str) -> Reply | None:
    """Return what the labelled lines of an undecorated text say; None where none of them names a target."""
    fields = list(_fields(text))
    named = [i for i, f in enumerate(fields) if f.kind == "target" and _names_something(f.value)]
    if not named:
        return None
    first = min(named, key=lambda i: (is_nothing(fields[i].value), _is_sentence(fields[i])))
    reply = _reply(fields[first], fields[:first], fields[first + 1 :])
    said_hidden = any(is_nothing(fields[i].value) for i in named if i < first)
    return replace(reply, visible="no") if said_hidden and not reply.visible else reply


_BRACKETED = re.compile(r"\[\s*object(?:[\s_-]*part)?\s*[:=][^\]\n]+\]?", re.IGNORECASE)
_PART_LINE = re.compile(r"^\W*(object[\s_-]*part\s*[:=]\s*\S.*)$", re.IGNORECASE | re.MULTILINE)
_SPOKEN_MARK = re.compile(r"\bmark\s*(?:no\.?|number)?\s*[:=#]?\s*(\d{1,6})\b", re.IGNORECASE)


def read_unlabelled(text: str) -> Reply | None:
    """Return what an undecorated text says without a line that names its target.

    That is an "[object: ...]" anywhere, a line "object part: ...", the only object described, or the only mark.
    """
    fields = list(_fields(text))
    described = {f.value for f in fields if f.kind == "object" and _names_something(f.value)}
    written = next((m[0] for pattern in (_BRACKETED, _PART_LINE) for m in pattern.finditer(text)), "")
    target = written or (described.pop() if len(described) == 1 else "")
    marks = set(_SPOKEN_MARK.findall(text))
    if not target and len(marks) != 1:
        return None
    reply = _reply(_Field("target", target), [], fields)
    return reply if target else replace(reply, target="", mark=marks.pop())


def _names_something(value: str) -> bool:
    return re.search(r"\w", value) is not None and not is_placeholder(value)


def _is_sentence(f: _Field) -> bool:
    """Whether a target is named in a sentence ("the target is under the towel") and not behind a label."""
    return f.label.rstrip().lower().endswith(" is")


def undecorated(text: str) -> str:
    """Return text in plain punctuation, without markdown, with each row of a table as labelled lines."""
    text = re.sub(r"<br\s*/?>|```\w*", "\n", text).replace("`", "")
    text = re.sub(r"</?(?:b|i|em|strong|code|p|li|ul|ol|h\d|span|answer)>", "", text)
    text = unicodedata.normalize("NFKC", text.translate(_PUNCTUATION)).translate(_PUNCTUATION)
    text = re.sub(r"\*\*|__|(?<!\w)[*_](?=\w)|(?<=[\w:.\])])\*", "", text)
    return "\n".join(_without_tables([plain(line) for line in text.split("\n")]))


def _without_tables(lines: list[str]) -> Iterator[str]:
    """Yield the lines; a table, known by the rule below its header, as "header: value" lines."""
    header: list[str] = []
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if header and "|" in line:
            if not _TABLE_RULE.fullmatch(line):
                yield from (f"{name}: {value}" for name, value in zip(header, _cells(line), strict=False))
            continue
        is_header = "|" in line and _TABLE_RULE.fullmatch(below) is not None
        header = _cells(line) if is_header else []
        if not is_header:
            yield line


def _cells(row: str) -> list[str]:
    return [c.strip() for c in row.strip("| ").split("|")]


def _fields(text: str) -> Iterator[_Field]:
    """Yield the labelled values in order; a label at the end of a line takes the next line as its value."""
    pending: _Field | None = None
    for line in text.split("\n"):
        start = _BULLET.match(line)
        line = line[start.end() :] if start else line
        if not line.strip():
            continue
        found = list(_labels(line))
        if not found:
            if pending is not None:
                yield pending._replace(value=line)
                pending = None
            else:
                yield _Field("line", line)
            continue
        if pending is not None:
            yield pending
            pending = None
        before = line[: found[0].start()]
        for match, after in zip(found, [*found[1:], None], strict=True):
            kind = match.lastgroup or ""
            value = line[match.end() : after.start() if after else len(line)].strip()
            f = _Field(kind, value, match[0], before)
            before = ""
            if value or kind in ("header", "other", "rationale"):
                yield f
            elif after is None:
                pending = f
    if pending is not None:
        yield pending


def _labels(line: str) -> Iterator[re.Match[str]]:
    """Yield a line's labels; "object:" is one at the line's start or behind other labels, not in "[object: mug]"."""
    listing = False
    for match in _LABEL.finditer(line):
        if match.lastgroup != "object" or match.start() == 0 or listing:
            yield match
        listing |= match.lastgroup in ("header", "box", "score", "cell")


@dataclass
class _Draft:
    name: str
    score: str = ""
    cell: str = ""

    def has(self, kind: str) -> bool:
        return bool(self.score if kind == "score" else self.cell)


@dataclass
class _Collector:
    """Turns fields into a target's own values and entries of the objects listed."""

    own: _Draft
    listed: list[_Draft] = field(default_factory=list)
    heading: str = ""
    """The last line without a label: an object's name if a score or a cell follows."""

    def add(self, f: _Field) -> None:
        if f.kind == "line":
            self.heading = f.value
        elif f.kind == "header":
            self.heading = ""
        elif f.kind == "object":
            self._open(f.value)
        elif f.kind in ("score", "cell"):
            name = _LEAD_OUT.sub("", f.before[:MAX_BEFORE_CHARS]) or (
                self.heading if self._current.has(f.kind) or self.heading else ""
            )
            if re.search(r"[^\W\d_]", name) and len(name) <= MAX_NAME_CHARS:
                self._open(name)
            if not self._current.has(f.kind):
                setattr(self._current, f.kind, f.value)

    @property
    def _current(self) -> _Draft:
        return self.listed[-1] if self.listed else self.own

    def _open(self, name: str) -> None:
        self.listed.append(_Draft(name))
        self.heading = ""


def _reply(target: _Field, before: list[_Field], after: list[_Field]) -> Reply:
    collector = _Collector(_Draft(target.value))
    for f in after:
        collector.add(f)
    if not collector.listed and not collector.own.score:
        collector = replace(collector, heading="")
        for f in before:
            collector.add(f)
    first = {f.kind: f.value for f in reversed([*before, *after])}
    label = target.label.lower()
    is_part = "part" in label and not re.search(r"/|&|\b(?:or|and)\b", label)
    entries = [Entry(d.name, d.score, d.cell) for d in collector.listed]
    if collector.own.score:
        entries.insert(0, Entry(target.value, collector.own.score, collector.own.cell))
    return Reply(
        target=target.value,
        kind="part" if is_part else first.get("kind", ""),
        role=first.get("role", ""),
        visible=first.get("visible", ""),
        mark=first.get("mark", ""),
        cell=collector.own.cell,
        pixel=_untruncated(first.get("pixel", ""), is_last=not after or after[-1].kind == "pixel", numbers=2),
        box=_untruncated(first.get("box", ""), is_last=not after or after[-1].kind == "box"),
        rationale=first.get("rationale", ""),
        entries=tuple(entries[:MAX_ENTRIES]),
    )


def _untruncated(value: str, *, is_last: bool, numbers: int = 4) -> str:
    """Return the text of so many numbers, as of a box; "" where the reply was cut off within it."""
    opened = len(re.findall(r"[(\[{]", value)) > len(re.findall(r"[)\]}]", value))
    return "" if is_last and (opened or len(re.findall(r"\d+", value)) < numbers) else value
