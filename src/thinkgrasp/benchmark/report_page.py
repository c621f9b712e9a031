"""A report as one HTML page that loads nothing: tables that can be read aloud, plots as inline SVG, light and dark."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import resources

from thinkgrasp.benchmark.document import FOLDED, Block, Figure, Items, Section, Table, Text

_STYLE = resources.files("thinkgrasp.benchmark").joinpath("report.css").read_text("utf-8")
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, sections: Sequence[Section]) -> str:
    """Return the page."""
    links = "".join(
        f'<li><a href="#s{i}">{escape(section.title)}</a></li>'
        for i, section in enumerate(sections)
        if section.level == 2 or len(sections) < 12
    )
    body = "\n".join(
        "\n".join(
            [
                f'<section id="s{i}">',
                f"<h{s.level}>{escape(s.title)}</h{s.level}>",
                *map(_block, s.blocks),
                "</section>",
            ]
        )
        for i, s in enumerate(sections)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"/>
<meta name="viewport" content="width=device-width, initial-scale=1"/>
<meta http-equiv="Content-Security-Policy" content="{_POLICY}"/>
<link rel="icon" href="data:,"/>
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<main>
<h1>{escape(title)}</h1>
<nav aria-label="Sections"><ul>{links}</ul></nav>
{body}
</main>
</body>
</html>
"""


def _block(block: Block) -> str:
    if isinstance(block, Table):
        return _table(block)
    if isinstance(block, Figure):
        note = f'<p class="note">{escape(block.note)}</p>' if block.note else ""
        return f"<figure><figcaption>{escape(block.title)}</figcaption>\n{block.svg}\n{note}</figure>"
    if isinstance(block, Items):
        return _items(block)
    return _text(block)


def _text(block: Text) -> str:
    if block.kind == "code":
        return f"<pre><code>{escape(block.words)}</code></pre>"
    kind = "" if block.kind == "plain" else f' class="{block.kind}"'
    return f"<p{kind}>{escape(block.words)}</p>"


def _items(block: Items) -> str:
    items = f'<ul class="items">{"".join(f"<li>{escape(item)}</li>" for item in block.items)}</ul>'
    if len(block.items) > FOLDED:
        return f"<details><summary>{escape(block.title)}</summary>{items}</details>"
    return f'<p class="list-title">{escape(block.title)}</p>{items}'


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.columns)
    rows: list[str] = []
    for i, row in enumerate(table.rows):
        shades = table.shades[i] if table.shades else (None,) * len(row)
        cells = [f'<th scope="row">{escape(row[0])}</th>']
        cells += [f"<td{_shade(s)}>{escape(cell)}</td>" for cell, s in zip(row[1:], shades[1:], strict=True)]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(table.title)}"><table>'
        f"<caption>{escape(table.title)}</caption>\n<thead><tr>{head}</tr></thead>\n<tbody>\n"
        + "\n".join(rows)
        + f"\n</tbody></table></div>{note}"
    )


def _shade(share: float | None) -> str:
    """Return a tint from red over none to green; the cell's own figure says the same in words."""
    if share is None:
        return ""
    color, strength = ("--shade", share - 0.5) if share >= 0.5 else ("--low", 0.5 - share)
    return f' style="background: rgb(var({color}) / {100 * strength:.0f}%)"'
