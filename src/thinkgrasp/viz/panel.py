"""One step of an episode as a piece of HTML: what was seen, why what was chosen, and what became of it."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape

from PIL import Image

from thinkgrasp.episode import OutcomeModel, StepLine
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Decision, Outcome, Proposal, Usage
from thinkgrasp.viz.compact import compact_scene
from thinkgrasp.viz.graph import MEANING, describe, draw_graph
from thinkgrasp.viz.overlay import draw_overlay

WEBP_QUALITY = 78
OUTCOMES = {
    "held": ("Held", "It was between both finger pads after the lift and after the transport."),
    "missed": ("Missed", "The fingers closed on nothing."),
    "slipped": ("Slipped", "It was lifted and then lost."),
    "unreachable": ("Out of reach", "No motion to the grasp was found."),
    "still_there": ("Still there", "It was held, but is still seen where it was."),
    "collision": ("Collision", "The motion touched something and was stopped."),
}
"""A reason's name and what it means."""


def render_panel(
    step: int,
    decision: Decision,
    outcome: Outcome | None,
    gripper: Gripper,
    *,
    duration_s: float,
    earlier: Sequence[StepLine] = (),
    picture: Image.Image | None = None,
) -> str:
    """Return one step's panel, complete with its pictures.

    Args:
        step: Number of the step, from 1.
        decision: What was decided.
        outcome: What became of it; None where nothing was executed.
        gripper: Geometry of the gripper to draw.
        duration_s: Wall time of the whole step [s].
        earlier: The steps before, of which the failed ones are listed.
        picture: `draw_overlay(decision, gripper)` where it has been drawn already.
    """
    picture = draw_overlay(decision, gripper) if picture is None else picture
    result = None if outcome is None else OutcomeModel(success=outcome.success, reason=outcome.reason)
    said = f'<p class="why" dir="auto">{text(decision.plan.rationale)}</p>' if decision.plan.rationale else ""
    columns = "".join((_plan(decision), _graph(decision), _checks(decision), _times(decision, duration_s)))
    return f"""<article class="step" id="step-{step}" aria-labelledby="step-{step}-title">
<header><span class="number" aria-label="Step">{step}</span>
<div><h2 id="step-{step}-title" dir="auto">{title(decision.status, decision.plan.role, decision.plan.target)}</h2>
<p>{_meaning(decision, result)}</p></div>{badge(decision.status, result)}</header>
<div class="pictures">{_seen(step, decision, gripper, picture)}{_space(decision, gripper)}</div>
{said}<div class="columns">{columns}</div>
{_fallbacks(decision)}{_remembered(earlier)}</article>
"""


def title(status: str, role: str, target: str) -> str:
    """Return the step in one line of HTML."""
    name = f"<em>{text(target)}</em>"
    if status == "no_target":
        return f"Nothing to take for {name}" if target else "Nothing to take"
    if status == "no_grasp":
        return f"No grasp survived on {name}"
    return f"Take the goal: {name}" if role == "goal" else f"Clear the way: {name}"


def badge(status: str, outcome: OutcomeModel | None) -> str:
    """Return the outcome as a coloured label that also carries a sign and a word."""
    if outcome is None:
        words = {"grasp": "Not executed", "no_target": "No target", "no_grasp": "No grasp"}[status]
        return f'<span class="badge none"><i aria-hidden="true">–</i>{words}</span>'
    name, _ = OUTCOMES.get(outcome.reason, (outcome.reason.replace("_", " ").capitalize(), ""))
    kind, sign = ("good", "✓") if outcome.success else ("bad", "✕")
    return f'<span class="badge {kind}"><i aria-hidden="true">{sign}</i>{text(name)}</span>'


def text(words: str) -> str:
    """Escape for HTML; halves of surrogate pairs and NUL, which no page may hold, become marks or vanish."""
    return escape(words.encode("utf-8", "replace").decode("utf-8").replace("\x00", ""))


def data_url(image: Image.Image) -> str:
    """Return a picture as a WebP data URL."""
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=WEBP_QUALITY, method=3)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _meaning(decision: Decision, outcome: OutcomeModel | None) -> str:
    if outcome is not None:
        return OUTCOMES.get(outcome.reason, ("", "The robot reported this reason."))[1]
    return {
        "grasp": "The grasp was chosen but not carried out.",
        "no_target": "Nothing in view answers to the instruction or can hide what does.",
        "no_grasp": "Every candidate failed one of the checks.",
    }[decision.status]


def _seen(step: int, decision: Decision, gripper: Gripper, picture: Image.Image) -> str:
    """The camera's picture, with the decision or with all numbered things."""
    plain = replace(decision, target=None, grasp=None, preferred_point=None, degraded=())
    camera = decision.scene.frame.camera
    height = picture.width * camera.height // camera.width  # below it stands a caption, which the panel says anyway
    size = f'width="{picture.width}" height="{height}"'
    n = len(decision.scene.proposals)
    tabs = (
        ("decision", "Decision", picture, f"Camera picture with the decision: {decision.plan.target}"),
        ("marks", f"Marks ({n})", draw_overlay(plain, gripper), f"Camera picture with {n} numbered things"),
    )
    inputs = "".join(
        f'<input type="radio" name="seen-{step}" id="seen-{step}-{key}"{" checked" if i == 0 else ""}>'
        f'<label for="seen-{step}-{key}">{label}</label>'
        for i, (key, label, _, _) in enumerate(tabs)
    )
    images = "".join(
        f'<img class="{key}" {size} decoding="async" alt="{text(alt)}" '
        f'src="{data_url(image.crop((0, 0, image.width, height)))}">'
        for key, _, image, alt in tabs
    )
    return f'<figure class="seen"><div class="tabs">{inputs}<div class="images">{images}</div></div></figure>'


def _space(decision: Decision, gripper: Gripper) -> str:
    """A place for the turntable, filled by the page's script when it comes into view."""
    camera = decision.scene.frame.camera
    toggle = '<button type="button" data-toggle="candidates" aria-pressed="true">Candidates</button>'
    toggle = toggle if decision.alternatives else ""
    return (
        f'<figure class="space" style="aspect-ratio:{camera.width}/{camera.height}">'
        '<canvas tabindex="0" role="img" aria-label="The point cloud with the gripper and the candidates"></canvas>'
        '<button type="button" class="wake">Turn it in 3-D</button>'
        '<div class="views"><button type="button" data-view="camera">Camera</button>'
        '<button type="button" data-view="close">Close-up</button>'
        f"{toggle}</div>"
        f'<script type="application/json">{compact_scene(decision, gripper)}</script></figure>'
    )


def _plan(decision: Decision) -> str:
    plan, target, grasp = decision.plan, decision.target, decision.grasp
    role = "the goal" if plan.role == "goal" else "an obstruction"
    facts = [("Take", text(plan.target)), ("It is", role)]
    if plan.mark is not None:
        facts.append(("Mark", str(plan.mark)))
    if target is not None:
        facts.append(("Match", f"{target.score:.2f}"))
        where = f"{plan.cell} of {plan.grid} × {plan.grid}"
        facts.append(("Cell", f"{where} {_cells(plan.grid, plan.cell)}"))
    if grasp is not None:
        facts.append(("Opening", f"{grasp.width_m * 1e3:.0f} mm"))
        facts.append(("Grasp score", f"{grasp.score:.2f}"))
    if plan.usage.requests:
        facts.append(("Asked", spent(plan.usage)))
    rows = "".join(f'<dt>{name}</dt><dd dir="auto">{value}</dd>' for name, value in facts)
    return f"<section><h3>Plan</h3><dl>{rows}</dl>{_considered(decision)}</section>"


def spent(usage: Usage) -> str:
    """Return what asking a model took, as HTML in one line."""
    tokens = usage.prompt_tokens + usage.completion_tokens
    cost = "price unknown" if usage.usd is None else f"{usage.usd:.4f} USD"
    requests = _count(usage.requests, "request")
    return text(f"{usage.model}: {requests}, {tokens} tokens, {cost}, {usage.latency_s:.1f} s")


def _considered(decision: Decision) -> str:
    """What the planner thought of, with its opinion of how well each can be grasped."""
    objects = sorted(decision.plan.objects, key=lambda o: -o.grasp_score)
    if not objects:
        return ""
    rows = "".join(f"<li>{text(o.name)} <b>{o.grasp_score:.0f}</b></li>" for o in objects)
    note = '<p class="quiet">How well it can be grasped, 0–100.</p>'
    return _details(f"{_count(len(objects), 'object')} considered", f'<ul class="scores">{rows}</ul>{note}')


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


CHOSEN = ' class="chosen"'


def _cells(grid: int, cell: int) -> str:
    squares = "".join(
        f'<rect x="{i % grid}" y="{i // grid}" width=".86" height=".86"{CHOSEN if i + 1 == cell else ""}/>'
        for i in range(grid * grid)
    )
    return f'<svg class="cells" viewBox="0 0 {grid} {grid}" aria-hidden="true">{squares}</svg>'


def _graph(decision: Decision) -> str:
    scene = decision.scene
    if not scene.proposals:
        return ""
    mark = decision.plan.mark
    hot = [e for e in scene.obstructions if e.b == mark]
    cold = [e for e in scene.obstructions if e.b != mark]
    parts = [draw_graph(scene, mark)]
    kinds = [kind for kind in MEANING if any(e.relation == kind for e in scene.obstructions)]
    if kinds:
        names = "".join(f'<span class="{kind}">{MEANING[kind]}</span>' for kind in kinds)
        parts.append(f'<p class="legend">{names}</p>')
    if hot:
        parts.append(_list("hot", map(describe, hot)))
    elif mark is not None:
        parts.append(f'<p class="quiet">Nothing is in the way of {mark}.</p>')
    if cold:
        noun = "other relation" if hot else "relation"
        parts.append(_details(_count(len(cold), noun), _list("", map(describe, cold))))
    parts.append(_details(f"{_count(len(scene.proposals), 'thing')} seen", _list("", map(_looks, scene.proposals))))
    return f"<section><h3>What is in whose way</h3>{''.join(parts)}</section>"


def _list(kind: str, items: Iterable[str]) -> str:
    return f'<ul class="{kind}">' + "".join(f"<li>{text(item)}</li>" for item in items) + "</ul>"


def _details(summary: str, body: str) -> str:
    return f"<details><summary>{summary}</summary>{body}</details>"


def _looks(proposal: Proposal) -> str:
    """A proposal in words: mark, main colour and shape, sides."""
    names = [pairs[0][0] for pairs in (proposal.colors, proposal.shapes) if pairs]
    sides = " × ".join(f"{100 * side:.0f}" for side in proposal.extents_m)
    cut = "; cut by the border" if proposal.touches_border else ""
    return f"{proposal.mark}: {', '.join([*names, f'{sides} cm'])}{cut}"


def _checks(decision: Decision) -> str:
    if not decision.funnel:
        return ""
    first = max(decision.funnel[0].n_in, 1)
    rows = [(s.check, str(s.n_out), s.n_out / first) for s in decision.funnel]
    chosen = 1 if decision.grasp is not None else 0
    return (
        "<section><h3>Grasps left after each check</h3>"
        + _bars([*rows, ("chosen", str(chosen), chosen / first)])
        + "</section>"
    )


def _times(decision: Decision, duration_s: float) -> str:
    laps = [(name, ms) for name, ms in decision.timings_ms if name != "total"]
    total = max(dict(decision.timings_ms).get("total", 0.0), 1e-9)
    rows = [(name, f"{ms:.0f} ms", ms / total) for name, ms in laps]
    rows.append(("decision", f"{total:.0f} ms", 1.0))
    whole = f'<p class="quiet">The whole step took {duration_s:.1f} s.</p>'
    return f"<section><h3>Time</h3>{_bars(rows)}{whole}</section>"


def _bars(rows: Iterable[tuple[str, str, float]]) -> str:
    body = "".join(
        f'<tr><th scope="row">{text(name.replace("_", " "))}</th>'
        f'<td class="bar"><i style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></i></td><td>{value}</td></tr>'
        for name, value, share in rows
    )
    return f"<table>{body}</table>"


def _fallbacks(decision: Decision) -> str:
    if not decision.degraded:
        return ""
    items = "".join(
        f"<li><b>{text(d.stage)}</b>: {text(d.reason)}; instead: {text(d.fallback)}</li>" for d in decision.degraded
    )
    return f'<aside class="note"><h3>Fallbacks taken</h3><ul dir="auto">{items}</ul></aside>'


def _remembered(earlier: Sequence[StepLine]) -> str:
    failed = [line for line in earlier if line.outcome is not None and not line.outcome.success]
    if not failed:
        return ""
    items = "".join(
        f'<li><a href="#step-{line.step}">Step {line.step}</a>: {text(line.target)}, cell {line.cell}, '
        f"{text(line.outcome.reason.replace('_', ' ')) if line.outcome else ''}</li>"
        for line in failed
    )
    return f'<aside class="note"><h3>Remembered failures before this step</h3><ul>{items}</ul></aside>'
