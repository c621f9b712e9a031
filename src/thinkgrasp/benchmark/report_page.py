"""A report as one HTML page that loads nothing: tables that can be read aloud, plots as inline SVG, light and dark."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from thinkgrasp.benchmark.document import Block, Figure, Items, Section, Table, Text

FOLDED = 6
"""Lists longer than this are folded away."""
_STYLE = """
:root { color-scheme: light dark; --paper: #f6f7f8; --card: #fff; --ink: #16191d; --soft: #56606b; --line: #dfe3e8;
  --good: #1f7a45; --bad: #b23a2a; --warn: #fff3d6; --shade: 31 122 69; --low: 178 58 42; --on: #fff;
  --s0: #1f6fb2; --s1: #b8501a; --s2: #2f7d40; --s3: #7a4ea3; --s4: #a8842c; --s5: #1f7f8a; --s6: #b03a75; --s7: #5b6572; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171b; --card: #1c2026; --ink: #e8ebef; --soft: #a6afb9;
  --line: #333a43; --good: #58bd82; --bad: #e5796a; --warn: #46391a; --shade: 88 189 130; --low: 229 121 106; --on: #14171b;
  --s0: #62b2ec; --s1: #f0935c; --s2: #74c98a; --s3: #b99af0; --s4: #dcbb5f; --s5: #63c3d6; --s6: #ec86b8; --s7: #a4afbb; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; overflow-wrap: anywhere; }
main { max-width: 1180px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 16px; } h2 { margin: 40px 0 12px; font-size: 23px; }
h3 { margin: 34px 0 10px; font-size: 18px; } p { margin: 0 0 12px; }
nav ul { padding: 0; margin: 0 0 12px; list-style: none; display: flex; flex-wrap: wrap; gap: 4px 16px; }
a { color: inherit; } :focus-visible { outline: 2px solid var(--s0); outline-offset: 2px; }
.scroll { overflow-x: auto; margin: 0 0 6px; background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 14px; }
caption { text-align: left; font-weight: 650; padding: 10px 12px; }
th, td { padding: 6px 12px; text-align: right; border-top: 1px solid var(--line); overflow-wrap: normal; }
thead th { color: var(--soft); font-weight: 600; vertical-align: bottom; }
th:first-child { text-align: left; } tbody th { font-weight: 600; white-space: nowrap; } td { white-space: nowrap; }
.note { color: var(--soft); font-size: 13px; margin-bottom: 22px; max-width: 90ch; }
.warning { background: var(--warn); border-left: 4px solid var(--bad); padding: 10px 14px; border-radius: 4px; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; overflow-x: auto; }
figure { margin: 0 0 22px; padding: 12px 14px; background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
figcaption { font-weight: 650; margin-bottom: 8px; } figure .note { margin: 8px 0 0; }
svg { width: 100%; max-width: 900px; height: auto; display: block; font: 13px system-ui, sans-serif; }
svg text { fill: var(--ink); } svg text.on { fill: var(--on); font-weight: 650; font-size: 12px; }
details { margin: 0 0 12px; } summary, .list-title { font-weight: 650; cursor: pointer; } .list-title { cursor: auto; margin: 0; }
ul.items { margin: 6px 0 14px; padding-left: 22px; }
"""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, sections: Sequence[Section]) -> str:
    """Return the page."""
    links = "".join(
        f'<li><a href="#s{i}">{escape(section.title)}</a></li>'
        for i, section in enumerate(sections)
        if section.level == 2 or len(sections) < 12
    )
    body = "\n".join(
        f'<section id="s{i}">\n<h{s.level}>{escape(s.title)}</h{s.level}>\n'
        + "\n".join(map(_block, s.blocks))
        + "\n</section>"
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
