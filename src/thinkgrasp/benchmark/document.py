"""A report as sections of text, tables and figures, and its form in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

FIGURES = "plots"
FOLDED = 6
"""Lists longer than this are folded away."""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    words: str
    kind: Literal["plain", "note", "warning", "code"] = "plain"


@dataclass(frozen=True)
class Items:
    """A list; long ones are folded away."""

    title: str
    items: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Rows of cells; the first of each is the row's name."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    shades: tuple[tuple[float | None, ...], ...] = ()
    """Of every cell, 0..1 from bad to good; empty = none is shaded."""


@dataclass(frozen=True)
class Figure:
    """A plot; what it shows stands in a table too."""

    title: str
    name: str
    """Of its file, without the ending."""
    svg: str
    note: str = ""


Block = Text | Items | Table | Figure


@dataclass(frozen=True)
class Section:
    """A part of a report with a heading."""

    title: str
    blocks: tuple[Block, ...]
    level: Literal[2, 3] = 2


def markdown(title: str, sections: Sequence[Section]) -> str:
    """Return a report in Markdown; figures are files in the folder FIGURES beside it."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"{'#' * section.level} {section.title}", ""]
        for block in section.blocks:
            lines += [*_block(block), ""]
    return "\n".join(lines).rstrip() + "\n"


def table_lines(table: Table) -> list[str]:
    """Return the rows of a table in Markdown, padded so that they can be read as they are."""
    cells = [tuple(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in (table.columns, *table.rows)]
    widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(table.columns))]
    rows = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    return [rows[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *rows[1:]]


def _block(block: Block) -> list[str]:
    if isinstance(block, Table):
        return [f"**{block.title}**", "", *table_lines(block), *(["", block.note] if block.note else [])]
    if isinstance(block, Figure):
        picture = f"![{block.title}]({FIGURES}/{block.name}.svg)"
        return [f"**{block.title}**", "", picture, *(["", block.note] if block.note else [])]
    if isinstance(block, Items):
        items = [f"- {item}" for item in block.items]
        if len(items) > FOLDED:
            return ["<details>", f"<summary>{block.title}</summary>", "", *items, "", "</details>"]
        return [f"**{block.title}**", "", *items]
    if block.kind == "code":
        return ["```", block.words, "```"]
    return [f"> **Warning.** {block.words}"] if block.kind == "warning" else [block.words]
