"""Read a reply in JSON: strict, as Python prints it, with prose around it, or cut off."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping

from thinkgrasp.planners.reply_values import Entry, Reply, plain

Value = str | list["Value"] | dict[str, "Value"]
"""Numbers, booleans and null are kept as the text they are written in; null is ""."""

MAX_STARTS = 50
MAX_DEPTH = 12
MAX_ENTRIES = 64

_GAP = re.compile(r"(?:[\s,]+|//[^\n]*|/\*.*?\*/)*", re.DOTALL)
_QUOTED = {
    mark: re.compile(rf"{mark}((?:[^{mark}\\]|\\.|{mark}(?!\s*(?:[,:}}\]]|\Z)))*){mark}", re.DOTALL) for mark in "\"'"
}
_KEY = re.compile(r"[A-Za-z_]\w*(?=\s*:)")
_SCALAR = re.compile(r"[^\s,:{}\[\]\"']+(?=[\s,}\]])")

_TARGET = ("target", "targetobject", "selectedobject", "selectedobjectpart", "selectedobjectobjectpart", "selected")
_CELL = (
    *("cell", "preferredcell", "preferredgraspinglocation", "preferredgrasplocation", "preferredlocation"),
    *("graspinglocation", "grasplocation", "gridcell", "location"),
)
_BOX = ("croppingbox", "croppingboxcoordinates", "cropbox", "crop", "cropxyxy", "boundingbox", "bbox", "box")
_PIXEL = ("grasppixel", "graspingpixel", "pixel")
_OBJECTS = ("objects", "objectsandtheirproperties", "objectproperties", "candidates")
_NAME = ("name", "object", "objectname", "label", "item")
_SCORE = ("graspscore", "graspingscore", "graspability", "score")
_MARK = ("mark", "marknumber", "markid")
_RATIONALE = ("rationale", "reason", "reasoning", "explanation")


def read_json(text: str) -> Reply | None:
    """Return the first JSON object of a text that names a target; what is complete of one that is cut off."""
    for value in _objects(text):
        found = _with_target(value)
        if found is not None:
            return _reply(found)
    return None


def _reply(fields: Mapping[str, Value]) -> Reply:
    return Reply(
        target=_text(fields, _TARGET),
        kind=_text(fields, ("kind", "type")),
        role=_text(fields, ("role",)),
        visible=_text(fields, ("visible", "goalvisible", "targetvisible", "isvisible")),
        mark=_text(fields, _MARK),
        cell=_text(fields, _CELL),
        box=_text(fields, _BOX),
        pixel=_text(fields, _PIXEL),
        rationale=_text(fields, _RATIONALE),
        entries=tuple(_entries(_get(fields, _OBJECTS)))[:MAX_ENTRIES],
    )


def _entries(value: Value) -> Iterator[Entry]:
    listed: list[tuple[str, Value]] = []
    if isinstance(value, dict):
        listed = list(value.items())
    elif isinstance(value, list):
        listed = [("", v) for v in value]
    for name, fields in listed:
        if isinstance(fields, dict):
            named = _fields(fields)
            yield Entry(_text(named, _NAME) or name, _text(named, _SCORE), _text(named, _CELL), _text(named, _MARK))


def _with_target(value: Value, depth: int = 0) -> dict[str, Value] | None:
    """Return the fields of the outermost object that has a target or a mark, also within a wrapper."""
    if depth > 3 or isinstance(value, str):
        return None
    if isinstance(value, dict):
        fields = _fields(value)
        target = _get(fields, _TARGET)
        if isinstance(target, dict) and _text(_fields(target), _NAME):
            named = _fields(target)
            return {
                **named,
                **fields,
                "target": ": ".join(filter(None, (_text(named, _NAME), _text(named, ("part",))))),
            }
        if any(isinstance(fields.get(key), str) for key in _TARGET) or _text(fields, _MARK):
            return fields
    inner = value.values() if isinstance(value, dict) else value
    return next((found for v in inner if (found := _with_target(v, depth + 1)) is not None), None)


def _fields(value: Mapping[str, Value]) -> dict[str, Value]:
    """Return an object with keys that are compared by their letters and digits alone."""
    return {re.sub(r"[\W_]", "", key).lower(): v for key, v in value.items()}


def _get(fields: Mapping[str, Value], keys: tuple[str, ...]) -> Value:
    return next((fields[key] for key in keys if key in fields), "")


def _text(fields: Mapping[str, Value], keys: tuple[str, ...]) -> str:
    return plain(_flat(_get(fields, keys)))


def _flat(value: Value) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return "(" + ", ".join(f"{k}: {_flat(v)}" for k, v in value.items()) + ")"
    return "(" + ", ".join(_flat(v) for v in value) + ")"


def _objects(text: str) -> Iterator[Value]:
    """Yield the outermost objects of a text, left to right."""
    if text.lstrip()[:1] == '"':
        text = "{" + text  # a server that was given the first brace leaves it out of the reply
    at = 0
    for _ in range(MAX_STARTS):
        at = text.find("{", at)
        if at < 0:
            return
        reader = _Reader(text, at)
        value = reader.read()
        yield value or {}
        at = max(reader.at, at + 1)


class _Reader:
    """Reads one value and stops, without raising, where the text ends or is no JSON any more."""

    def __init__(self, text: str, at: int) -> None:
        self._text = text
        self.at = at
        self._stopped = False

    def read(self, depth: int = 0) -> Value | None:
        """Return the next value; what is complete of a container that is cut off; None where there is none."""
        start = self._text[self.at : self.at + 1]
        if start in ("{", "[") and depth < MAX_DEPTH:
            self.at += 1
            return self._object(depth) if start == "{" else self._list(depth)
        scalar = self._string() if start in _QUOTED else self._take(_SCALAR)
        if scalar is None:
            self._stopped = True
        elif start not in _QUOTED and scalar.lower() in ("null", "none"):
            return ""
        return scalar

    def _object(self, depth: int) -> dict[str, Value]:
        found: dict[str, Value] = {}
        while not self._closed("}"):
            quoted = self._text[self.at : self.at + 1] in _QUOTED
            key = self._string() if quoted else self._take(_KEY)
            self._skip()
            if key is None or self._text[self.at : self.at + 1] != ":":
                self._stopped = True
                break
            self.at += 1
            self._skip()
            value = self.read(depth + 1)
            if value is not None:
                found.setdefault(key, value)
        return found

    def _list(self, depth: int) -> list[Value]:
        found: list[Value] = []
        while not self._closed("]"):
            value = self.read(depth + 1)
            if value is not None:
                found.append(value)
        return found

    def _closed(self, bracket: str) -> bool:
        self._skip()
        if self._text[self.at : self.at + 1] == bracket:
            self.at += 1
            return True
        return self._stopped or self.at >= len(self._text)

    def _string(self) -> str | None:
        quoted = self._take(_QUOTED[self._text[self.at]])
        if quoted is None:
            return None
        inner = quoted[1:-1]
        try:
            return str(json.loads(f'"{inner}"', strict=False))
        except ValueError:
            return inner.replace("\\'", "'").replace('\\"', '"').replace("\\n", "\n")

    def _take(self, pattern: re.Pattern[str]) -> str | None:
        match = pattern.match(self._text, self.at)
        if match is None:
            return None
        self.at = match.end()
        return match[0]

    def _skip(self) -> None:
        match = _GAP.match(self._text, self.at)
        self.at = match.end() if match else self.at
