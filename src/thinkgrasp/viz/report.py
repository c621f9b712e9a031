"""An episode as one HTML page that opens anywhere: no network, no further files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from thinkgrasp.episode import REPORT_FILE, VIDEO_FILE, RecordedEpisode, RecordedStep, StepLine, read_episode
from thinkgrasp.errors import InputError
from thinkgrasp.loop import END_WORDS
from thinkgrasp.outputs import write_atomic
from thinkgrasp.types import Usage
from thinkgrasp.viz.panel import badge, spent, text

MAX_INLINE_VIDEO_BYTES = 16_000_000
"""A larger video is linked, not put into the page."""

_ENDS: Mapping[str, str] = {**END_WORDS}


def write_report(folder: str | Path) -> Path:
    """Write report.html from what has been recorded so far, and return its path.

    It works while the episode runs, after it has ended, and after it was killed. Each step's panel was made when the
    step was recorded, so that this only puts pieces together.

    Args:
        folder: A recorded episode.

    Raises:
        InputError: The folder holds no recorded episode, or cannot be written.
    """
    path = Path(folder) / REPORT_FILE
    write_atomic(path, render_report(read_episode(folder)).encode("utf-8", "replace"))
    return path


def render_report(episode: RecordedEpisode) -> str:
    """Return the page that `write_report` writes."""
    files = resources.files("thinkgrasp.viz")
    parts = {
        "title": text(f"{episode.header.instruction} · ThinkGrasp episode"),
        "style": files.joinpath("report.css").read_text("utf-8"),
        "script": "".join(files.joinpath(name).read_text("utf-8") for name in ("view.js", "report.js")),
        "header": _header(episode),
        "video": _video(episode.folder),
        "steps": "".join(_panel(step) for step in episode.steps),
        "footer": _footer(episode),
    }
    template = files.joinpath("report.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda hole: parts[hole[1]], template)


def _panel(step: RecordedStep) -> str:
    path = step.folder / "panel.html"
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error


def _header(episode: RecordedEpisode) -> str:
    header, ended, n = episode.header, episode.ended, len(episode.steps)
    if ended is None:
        verdict = (
            '<span class="badge none"><i aria-hidden="true">…</i>Not ended</span><span>The records end here.</span>'
        )
    else:
        kind, sign, words = ("good", "✓", "Goal reached") if ended.success else ("bad", "✕", "Goal not reached")
        verdict = (
            f'<span class="badge {kind}"><i aria-hidden="true">{sign}</i>{words}</span>'
            f"<span>Ended because {text(_ENDS.get(ended.end, ended.end.replace('_', ' ')))}.</span>"
        )
    attempts = [s.line.outcome for s in episode.steps if s.line.outcome is not None]
    held = sum(o.success for o in attempts)
    facts = [
        ("Steps", str(n)),
        ("Grasps held", f"{held} of {len(attempts)}"),
        ("Goal", text(header.goal) or "not named"),
        ("Preset", text(header.preset)),
        ("Seed", str(header.seed)),
        ("Duration", f"{sum(s.line.duration_s for s in episode.steps):.1f} s"),
    ]
    if ended is not None and ended.usage.requests:
        facts.append(("Model", spent(Usage(**ended.usage.model_dump()))))
    rows = "".join(f'<div><dt>{name}</dt><dd dir="auto">{value}</dd></div>' for name, value in facts)
    items = "".join(
        f'<li><a href="#step-{s.line.step}"><b>{s.line.step}</b>'
        f'<span class="name" dir="auto">{_short(s.line)}</span>'
        f"{badge(s.line.status, s.line.outcome)}</a></li>"
        for s in episode.steps
    )
    return (
        f'<p class="kicker">ThinkGrasp episode</p><h1 dir="auto">“{text(header.instruction)}”</h1>'
        f'<div class="verdict">{verdict}</div>{_oracle(header.preset)}<dl class="facts">{rows}</dl>'
        f'<nav aria-label="Steps"><ol class="steps-nav">{items}</ol></nav>'
    )


def _short(line: StepLine) -> str:
    verb = "Seek" if line.status == "no_target" else "Take" if line.role == "goal" else "Clear"
    return f"{verb} {text(line.target)}"


def _oracle(preset: str) -> str:
    if "oracle" not in preset.lower():
        return ""
    return (
        '<p class="oracle" role="note"><b>Oracle: reads the simulator’s truth</b>Names and masks were not perceived. '
        "This is the upper bound of what perception could reach, not a result of the system.</p>"
    )


def _video(folder: Path) -> str:
    path = folder / VIDEO_FILE
    if not path.is_file():
        return ""
    if path.stat().st_size > MAX_INLINE_VIDEO_BYTES:
        return f'<p class="video">The video is too large for this page: <a href="{VIDEO_FILE}">{VIDEO_FILE}</a>.</p>'
    source = "data:image/webp;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure class="video"><img src="{source}" alt="Video of the episode from a second camera">'
        "<figcaption>The episode from a second camera</figcaption></figure>"
    )


def _footer(episode: RecordedEpisode) -> str:
    return (
        "In 3-D: drag to turn, wheel or pinch to zoom, right-drag or shift-drag to pan; Escape gives the page back. "
        f"The numbers behind this page lie beside it: <code>steps/NNN/decision.json</code>, <code>scene.json</code>, "
        f"<code>outcome.json</code>{' and <code>episode.json</code>' if episode.ended is not None else ''}."
    )
