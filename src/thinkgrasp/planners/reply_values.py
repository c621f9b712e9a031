"""Read single values of a model's reply: a name, a cell, a score, a box. Everything arrives as text."""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from typing import NamedTuple

from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.types import BoxXYXY, PlanKind

MAX_NAME_CHARS = 80
MAX_RATIONALE_CHARS = 1000
MAX_VALUE_CHARS = 400


class PlanParseError(ThinkGraspError):
    """A model's reply holds no usable plan; the message quotes the place."""


class Entry(NamedTuple):
    """What a reply says about one object, word for word."""

    name: str
    score: str = ""
    cell: str = ""
    mark: str = ""


@dataclass(frozen=True)
class Reply:
    """The fields of a reply, word for word; "" = not given."""

    target: str
    kind: str = ""
    role: str = ""
    visible: str = ""
    mark: str = ""
    cell: str = ""
    box: str = ""
    pixel: str = ""
    rationale: str = ""
    entries: tuple[Entry, ...] = ()


class Target(NamedTuple):
    """A target's name, whether it is a part, and the mark written beside it."""

    name: str
    kind: PlanKind
    mark: str


_NUMBER = r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:e[-+]?\d+)?"
_FREE_NUMBER = re.compile(rf"(?<![A-Za-z_\d.]){_NUMBER}", re.IGNORECASE)
_PLACEHOLDERS = {
    "name",
    "object",
    "part",
    "object name",
    "object or part",
    "object part",
    "object: part",
    "color and name",
    "target",
}
_NOTHING = re.compile(
    r"(?:none|nothing|null|n/a|not (?:visible|found|applicable)|no (?:\w+ )?(?:objects?|targets?|parts?))\b"
    r"(?! ?-)|[-.?]*$",
    re.IGNORECASE,
)
_PREFIX = re.compile(r"(?:(object[\s_-]*part\b\s*[:=]?|part\s*[:=])|(?:object|target)\s*[:=])\s*", re.IGNORECASE)
_AFTERTHOUGHT = re.compile(
    r"(?:[\s,;.]|\s-)*\b(?:because|since|as (?:it|the)|which|so that|due to)\b.*$|\.\s.*$", re.IGNORECASE | re.DOTALL
)
_ASIDE = re.compile(r"\s*\(\s*(?:[^\s()]+\s+){2,}[^\s()]*\s*\)?\s*$")
_BESIDE_MARK = re.compile(r"[\s,;]*[(\[]?\s*\bmark\s*(?:no\.?|number)?\s*[:=#]?\s*(\d+)\s*[)\]]?", re.IGNORECASE)
_ARTICLE = re.compile(r"\b(?:the|an?)\s+", re.IGNORECASE)


def plain(text: str) -> str:
    """Return text on one line without control characters, invisible ones, or halves of surrogate pairs."""
    shown = (" " if c.isspace() else c for c in text if c.isspace() or unicodedata.category(c)[0] != "C")
    return " ".join("".join(shown).split())


def quote(text: str, limit: int = 80) -> str:
    """Return the beginning of a reply as it is quoted in messages."""
    shown = plain(text[: 10 * limit])
    return repr(shown if len(shown) <= limit else f"{shown[:limit]}...")


def is_placeholder(text: str) -> bool:
    """Whether a value is only the form's own word, "<name>", as where a model repeats the form before filling it."""
    return text.strip().strip("<>[]").strip().lower() in _PLACEHOLDERS


def is_nothing(name: str) -> bool:
    """Whether a target says that there is nothing to take."""
    return _NOTHING.match(name) is not None


def read_target(text: str) -> Target:
    """Read "red mug", "[object: red mug]", "[object part: knife: handle]" or "knife: handle".

    Returns:
        The name, with the part behind the object ("knife handle"); "" where nothing is left but the form's own words.
    """
    value = plain(text[:MAX_VALUE_CHARS])
    beside = _BESIDE_MARK.search(value)
    if beside:
        value = value[: beside.start()] + value[beside.end() :]
    bracketed = re.match(r"\W*?\[([^\]]*)\]?", value)
    value = _bare(bracketed[1] if bracketed and bracketed[1].strip() else value)
    is_part = False
    while prefix := _PREFIX.match(value):
        is_part |= prefix[1] is not None
        value = _bare(value[prefix.end() :])
    second = re.search(r"[,;(\[]\s*(?:object\s*)?part\s*[:=]", value, re.IGNORECASE)
    if second:
        value = f"{value[: second.start()]}:{value[second.end() :]}"
    value = _ASIDE.sub("", _AFTERTHOUGHT.sub("", value))
    whole, colon, part = value.partition(":")
    if colon and len(part.split()) <= 4:
        is_part |= bool(part.strip())
        value = f"{whole} {part}"
    elif colon:
        value = whole
    value = re.sub(r"[()\[\]{}<>\"]+", " ", value)
    if is_part:
        value = re.sub(r"[,;/]|->", " ", value)
    name = _ARTICLE.sub("", _bare(" ".join(value.split())), count=1)
    name = "" if is_placeholder(name) else name[:MAX_NAME_CHARS].strip()
    return Target(name, "part" if is_part else "object", beside[1] if beside else "")


def _bare(text: str) -> str:
    return text.strip(" \t\"'`[](){}<>,;.:*|=_")


def read_mark(text: str) -> int | None:
    """Read a mark's number; None where none is given (null, none, 0, -1).

    Raises:
        PlanParseError: It is no whole number.
    """
    value = plain(text[:MAX_VALUE_CHARS]).strip("[]()#\"'")
    if not value or is_nothing(value) or value.lower() == "false":
        return None
    match = re.fullmatch(r"(?:mark|object|id)?\s*[#:]?\s*(-?\d{1,9})(?:\.0*)?", value, re.IGNORECASE)
    if match is None:
        raise PlanParseError(f"a mark must be the number drawn on the image, or null; the reply says {quote(text)}")
    return int(match[1]) if int(match[1]) > 0 else None


def read_score(text: str) -> float | None:
    """Read "85", "85/100", "8.5 out of 10", "85%" or "0.85" as 0..100; None where there is no number."""
    value = plain(text[:MAX_VALUE_CHARS]).replace(",", ".")
    match = re.search(rf"({_NUMBER})\s*(?:(?:/|out of|of)\s*({_NUMBER}))?\s*(%)?", value, re.IGNORECASE)
    if match is None:
        return None
    score, most = float(match[1]), float(match[2] or 0)
    if most > 0 and not match[3]:
        score = 100 * score / most
    elif 0 < score < 1 and not match[3]:
        score *= 100
    return round(min(max(score, 0.0), 100.0), 1) if math.isfinite(score) else None


_WORDS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")
_NUMBER_WORDS = {w: i + 1 for words in (_WORDS, _ORDINALS) for i, w in enumerate(words)}
_ROWS = {"top": 0, "upper": 0, "up": 0, "uppermost": 0, "bottom": 1, "lower": 1, "down": 1, "lowermost": 1, "low": 1}
_COLUMNS = {"left": 0, "leftmost": 0, "lefthand": 0, "right": 1, "rightmost": 1, "righthand": 1}
_MIDDLE = {"middle", "center", "centre", "central", "mid", "centered", "centred"}
_COMPOUND = re.compile(r"(top|upper|bottom|lower|middle|mid|cent(?:er|re))(left|right|cent(?:er|re)|middle)")


def read_cell(text: str, grid: int) -> int | None:
    """Read a cell as "5", "cell 5 of 9", "row 2, column 2", "five", "top-right", "upper left" or "middle".

    Args:
        text: The value.
        grid: Cells per side.

    Returns:
        1..grid*grid, row by row from the top-left; None where none is given.

    Raises:
        PlanParseError: It is none of these, or lies outside the grid.
    """
    value = plain(text[:MAX_VALUE_CHARS]).lower()
    if is_nothing(_bare(value)) or value in ("any", "anywhere"):
        return None
    value = re.sub(r"\d+\s*(?:x|×|by)\s*\d+", " ", value)
    cell = _cell_of_row_and_column(value, grid) or _cell_by_number(value) or _cell_by_place(value, grid)
    if cell is None or not 1 <= cell <= grid * grid:
        problem = f"lies outside 1..{grid * grid}" if cell is not None else f"is no cell 1..{grid * grid}"
        raise PlanParseError(f"the cell {quote(text)} {problem} of the {grid}x{grid} grid")
    return cell


def _cell_of_row_and_column(value: str, grid: int) -> int | None:
    match = re.search(r"\brow\W{0,3}(\d{1,4}).{0,12}?\bcol(?:umn)?\W{0,3}(\d{1,4})", value)
    match = match or re.fullmatch(r"[(\[]\s*(\d{1,4})\s*[,;]\s*(\d{1,4})\s*[)\]]\W*", value)
    if match is None:
        return None
    row, column = int(match[1]), int(match[2])
    return (row - 1) * grid + column if 1 <= row <= grid and 1 <= column <= grid else -1


def _cell_by_number(value: str) -> int | None:
    match = re.search(r"-?\d+(?:\.\d+)?", value)
    if match:
        number = float(match[0])
        return int(number) if number.is_integer() and abs(number) < 1e6 else -1
    return next((_NUMBER_WORDS[w] for w in re.findall(r"[a-z]+", value) if w in _NUMBER_WORDS), None)


def _cell_by_place(value: str, grid: int) -> int | None:
    value = re.split(r"\b(?:because|since|as|so|but)\b|[;.]", value)[0]
    words = re.findall(r"[a-z]+", _COMPOUND.sub(r"\1 \2", value))
    row = next((_ROWS[w] for w in words if w in _ROWS), None)
    column = next((_COLUMNS[w] for w in words if w in _COLUMNS), None)
    if row is None and column is None and not _MIDDLE & set(words):
        return None
    middle, last = (grid - 1) // 2, grid - 1
    r, c = (middle if side is None else side * last for side in (row, column))
    return r * grid + c + 1


_LABELLED = re.compile(
    rf"\b(?:(?P<x>x|left|right)|(?P<y>y|top|bottom)|(?P<w>w|width)|(?P<h>h|height))[\s_]*(?:min|max|[0-3])?\b"
    rf"[\"']?\s*[:=]\s*(?P<value>{_NUMBER})",
    re.IGNORECASE,
)


def read_box(text: str, image_wh: tuple[int, int]) -> BoxXYXY | None:
    """Read a box as x0, y0, x1, y1 in pixels (or shares or percents of the image), in any brackets, labelled or not.

    Returns:
        The box in order and clipped to the image; None where none is given.

    Raises:
        PlanParseError: It has not four numbers, has no area, or lies outside the image.
    """
    value = plain(text[:MAX_VALUE_CHARS])
    if not re.search(r"\d", value):
        return None
    numbers = _box_numbers(value)
    if numbers is None or not all(math.isfinite(n) for n in numbers):
        raise PlanParseError(f"a box must be four numbers x0, y0, x1, y1; the reply says {quote(text)}")
    w, h = image_wh
    if "%" in value:
        numbers = [n / 100 for n in numbers]
    if all(0 <= n <= 1 for n in numbers) and max(numbers) > 0:
        numbers = [n * side for n, side in zip(numbers, (w, h, w, h), strict=True)]
    (x0, x1), (y0, y1) = sorted(numbers[0::2]), sorted(numbers[1::2])
    x0, y0, x1, y1 = max(math.floor(x0), 0), max(math.floor(y0), 0), min(math.ceil(x1), w), min(math.ceil(y1), h)
    if x0 >= x1 or y0 >= y1:
        raise PlanParseError(f"the box {quote(text)} has no area inside the image of {w}x{h} pixels")
    return x0, y0, x1, y1


def read_pixel(text: str, image_wh: tuple[int, int]) -> tuple[int, int] | None:
    """Read a pixel as x, y in pixels (or shares or percents of the image), in any brackets, labelled or not.

    Returns:
        (u, v); None where none is given.

    Raises:
        PlanParseError: It has not two numbers, or lies outside the image.
    """
    value = plain(text[:MAX_VALUE_CHARS])
    if not re.search(r"\d", value):
        return None
    numbers = _numbers(value)
    if len(numbers) != 2 or not all(map(math.isfinite, numbers)):
        raise PlanParseError(f"a pixel must be two numbers x, y; the reply says {quote(text)}")
    w, h = image_wh
    if "%" in value:
        numbers = [n / 100 for n in numbers]
    if all(0 <= n <= 1 for n in numbers) and (max(numbers) < 1 or "." in value):
        numbers = [n * side for n, side in zip(numbers, (w, h), strict=True)]
    u, v = (math.floor(n) for n in numbers)
    if not (0 <= u <= w and 0 <= v <= h):
        raise PlanParseError(f"the pixel {quote(text)} lies outside the image of {w}x{h} pixels")
    return min(u, w - 1), min(v, h - 1)


def _box_numbers(value: str) -> list[float] | None:
    ranges = re.search(rf"\bx\W{{1,4}}({_NUMBER})\s*(?:-|to|\.\.)\s*({_NUMBER})\W+y\W{{1,4}}({_NUMBER})\s*"
                       rf"(?:-|to|\.\.)\s*({_NUMBER})", value, re.IGNORECASE)  # fmt: skip
    if ranges:
        x0, x1, y0, y1 = map(float, ranges.groups())
        return [x0, y0, x1, y1]
    if labelled := _labelled_numbers(value):
        return labelled
    if ";" in value:
        value = value.replace(",", "." if value.count(";") >= 3 else " ")
    groups = [_numbers(g) for g in re.findall(r"[(\[{<]([^()\[\]{}<>]*)[)\]}>]?", value)]
    whole = next((g for g in groups if len(g) == 4), None)
    corners = [n for g in groups if len(g) == 2 for n in g]
    loose = _numbers(value)
    return whole or (corners if len(corners) == 4 else None) or (loose if len(loose) == 4 else None)


def _labelled_numbers(value: str) -> list[float] | None:
    found: dict[str, list[float]] = {"x": [], "y": [], "w": [], "h": []}
    for match in _LABELLED.finditer(value):
        found[next(axis for axis in found if match[axis] is not None)].append(float(match["value"]))
    x, y, w, h = found.values()
    if len(x) == len(y) == 2:
        return [x[0], y[0], x[1], y[1]]
    if len(x) == len(y) == len(w) == len(h) == 1:
        return [x[0], y[0], x[0] + w[0], y[0] + h[0]]
    return None


def _numbers(text: str) -> list[float]:
    return [float(n) for n in _FREE_NUMBER.findall(text)]
