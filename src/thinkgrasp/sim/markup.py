"""XML with line numbers, so that a mistake in a file can be pointed at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError


@dataclass(eq=False)
class Node:
    """One element; stray text between elements is ignored."""

    tag: str
    attributes: dict[str, str]
    path: Path
    line: int
    children: list[Node] = field(default_factory=list)

    @property
    def where(self) -> str:
        """The file and the line, as "file:line"."""
        return f"{self.path}:{self.line}"

    def error(self, message: str) -> InputError:
        """Return an error that points at this element."""
        return InputError(f"{self.where}: {message}")

    def all(self, tag: str) -> list[Node]:
        """Return the children with this tag."""
        return [c for c in self.children if c.tag == tag]

    def one(self, tag: str) -> Node | None:
        """Return the child with this tag, if there is one.

        Raises:
            InputError: There is more than one.
        """
        found = self.all(tag)
        if len(found) > 1:
            raise found[1].error(f"<{self.tag}> holds a second <{tag}>; one is allowed")
        return found[0] if found else None

    def need(self, tag: str) -> Node:
        """Return the child with this tag.

        Raises:
            InputError: There is none, or more than one.
        """
        found = self.one(tag)
        if found is None:
            raise self.error(f"<{self.tag}> lacks a <{tag}>")
        return found

    def text(self, attribute: str, default: str | None = None) -> str:
        """Return an attribute.

        Raises:
            InputError: It is not there and there is no default.
        """
        value = self.attributes.get(attribute, default)
        if value is None:
            raise self.error(f'<{self.tag}> lacks {attribute}="..."')
        return value

    def numbers(
        self,
        attribute: str,
        count: int,
        *,
        default: Sequence[float] | None = None,
        positive: bool = False,
        within: tuple[float, float] | None = None,
    ) -> NDArray[np.float64]:
        """Return an attribute's numbers (count,), which are separated by spaces.

        Raises:
            InputError: It is not there, holds other than `count` finite numbers, or one outside the allowed range.
        """
        if default is not None and attribute not in self.attributes:
            return np.array(default, np.float64)
        text = self.text(attribute)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.array([np.nan])
        if len(values) != count or not np.isfinite(values).all():
            wanted = "one number" if count == 1 else f"{count} numbers"
            raise self.error(f"<{self.tag}> {attribute} must be {wanted}, got {text!r}")
        if positive and (values <= 0).any():
            raise self.error(f"<{self.tag}> {attribute} must be positive, got {text!r}")
        if within is not None and ((values < within[0]) | (values > within[1])).any():
            raise self.error(f"<{self.tag}> {attribute} must lie in {within[0]:g} to {within[1]:g}, got {text!r}")
        return values


def parse_markup(path: Path) -> Node:
    """Parse an XML file into its root element.

    Raises:
        InputError: The file cannot be read, is not well-formed, or declares a document type or entities.
    """
    parser = expat.ParserCreate()
    root: list[Node] = []
    stack: list[Node] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, path, parser.CurrentLineNumber)
        (stack[-1].children if stack else root).append(node)
        stack.append(node)

    def end(_tag: str) -> None:
        stack.pop()

    def doctype(*_: object) -> None:
        raise InputError(f"{path}:{parser.CurrentLineNumber}: a document type is not allowed here; remove <!DOCTYPE>")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        reason = expat.errors.messages[error.code]
        raise InputError(f"{path}:{error.lineno}: not well-formed XML: {reason} (column {error.offset + 1})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    return root[0]
