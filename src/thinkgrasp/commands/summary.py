"""A decision in words, for people at a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from thinkgrasp.schema import DecisionModel, GraspModel

_HEADLINES = {
    "grasp": ("grasp found", "bold green"),
    "no_grasp": ("no grasp: a target was found, but no grasp on it survived the checks", "bold yellow"),
    "no_target": ("no target: nothing in view fits the instruction", "bold yellow"),
}


def print_summary(model: DecisionModel, timings_ms: Mapping[str, float], out: TextIO) -> None:
    """Print what was decided, why, and how long each of the stages that were reached took."""
    console = Console(file=out, highlight=False, soft_wrap=True)
    headline, style = _HEADLINES[model.status]
    console.print(Text(headline, style=style))
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in _rows(model, timings_ms):
        table.add_row(name, Text(value))
    console.print(table)


def _rows(model: DecisionModel, timings_ms: Mapping[str, float]) -> list[tuple[str, str]]:
    plan, target, grasp = model.plan, model.target, model.grasp
    rows = [("instruction", model.instruction)]
    if model.status != "no_target":
        mark = "" if plan.mark is None else f", mark {plan.mark}"
        rows.append(("target", f"{plan.target} ({plan.role}{mark}, cell {plan.cell} of {plan.grid}x{plan.grid})"))
    rows.append(("why", plan.rationale))
    if target is not None:
        border = ", cut by the image border" if target.touches_border else ""
        rows.append(("seen as", f"{target.label}, box {_list(target.box_xyxy)} px, match {target.score:.2f}{border}"))
    if grasp is not None:
        rows += _grasp_rows(grasp)
        rows.append(("alternatives", str(len(model.alternatives))))
    if model.funnel:
        first = model.funnel[0].n_in
        steps = [f"{s.check} {s.n_out}" for s in model.funnel if s.check != "candidates"]
        rows.append(("candidates", " -> ".join([str(first), *steps])))
    rows += [("fell back", f"{d.stage}: {d.reason}; used {d.fallback}") for d in model.degraded]
    stages = ", ".join(f"{name} {ms:.0f}" for name, ms in timings_ms.items() if name != "total")
    rows.append(("time", f"{model.timings_ms.total:.0f} ms ({stages})"))
    if model.usage.model is not None:
        cost = "" if model.usage.usd is None else f", {model.usage.usd:.4f} USD"
        tokens = model.usage.prompt_tokens + model.usage.completion_tokens
        rows.append(("model", f"{model.usage.model}, {tokens} tokens{cost}"))
    return rows


def _grasp_rows(grasp: GraspModel) -> list[tuple[str, str]]:
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, -grasp.rotation[2][2]))))
    approach = f", approach {tilt:.0f} degrees from straight down" if grasp.frame == "world" else ""
    return [
        ("position", f"{_metres(grasp.position_m)} m in the {grasp.frame} frame{approach}"),
        ("quaternion", f"w x y z = {' '.join(f'{q:.4f}' for q in grasp.quat_wxyz)}"),
        ("opening", f"{grasp.width_m * 1000:.0f} mm"),
        ("score", f"{grasp.score:.2f}"),
        ("pre-grasp", f"{_metres(grasp.pregrasp_position_m)} m"),
    ]


def _metres(v: tuple[float, float, float]) -> str:
    return f"[{v[0]:.3f} {v[1]:.3f} {v[2]:.3f}]"


def _list(box: tuple[int, int, int, int]) -> str:
    return " ".join(str(c) for c in box)
