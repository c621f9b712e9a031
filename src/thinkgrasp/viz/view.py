"""The decision in three dimensions, as one HTML file that opens anywhere: no network, no further files."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.gripper import Gripper
from thinkgrasp.types import Decision, Grasp, Scene, SupportPlane
from thinkgrasp.viz.glyphs import (
    BOX_FACES,
    GRIPPER,
    MUTED,
    POINT,
    RGB,
    STATUS,
    STATUS_TEXT,
    Float,
    box_corners,
    to_camera,
)

MAX_POINTS = 120_000
GLYPH_BAR_M = 0.0018
GLYPH_STEM_M = 0.03
POINT_RADIUS_M = 0.005
PLANE_REACH_M = 0.4
PLANE_STEP_M = 0.05
PLANE_LIFT_M = 0.003
"""The grid floats this much above the support, so that the points of the support do not hide it."""
EDGE: RGB = (16, 58, 88)
SCORE_RAMP: tuple[RGB, RGB, RGB] = ((104, 84, 150), (64, 150, 160), (150, 220, 90))
"""Colours of a score of 0, 0.5 and 1."""

Kind = Literal["points", "lines", "triangles"]


@dataclass(frozen=True, eq=False)
class Layer:
    """Something that can be shown: vertices (N, 3) [m] in the camera frame and their colours (N, 3)."""

    name: str
    kind: Kind
    positions: NDArray[np.floating]
    colors: NDArray[np.uint8]
    spacing: float = 0.0
    """Size of a point's splat per metre of its depth, so that neighbouring pixels touch."""
    alpha: float = 1.0
    tintable: bool = False
    """The layer's toggle highlights it instead of hiding it."""

    def pack(self) -> dict[str, object]:
        """Return the layer as the page's script reads it."""
        return {
            "name": self.name,
            "kind": self.kind,
            "positions": _base64(self.positions, "<f4"),
            "colors": _base64(self.colors, "u1"),
            "spacing": self.spacing,
            "alpha": self.alpha,
            "tintable": self.tintable,
        }


def write_view(decision: Decision, gripper: Gripper, path: str | Path) -> None:
    """Write a self-contained HTML page with the cloud, the candidates and the chosen gripper on a turntable.

    The cloud holds at most MAX_POINTS points; where it must be thinned, the objects keep theirs and the background
    gives way. The first view is the camera's.

    Args:
        decision: Any status; what it lacks is not shown.
        gripper: Geometry of the gripper to draw.
        path: HTML file to write; an existing one is replaced.

    Raises:
        InputError: The file cannot be written.
    """
    page = render_view(decision, gripper)
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write the 3-D view to {path}: {error.strerror or error}") from error


def render_view(decision: Decision, gripper: Gripper) -> str:
    """Return the page that `write_view` writes."""
    files = resources.files("thinkgrasp.viz")
    camera = decision.scene.frame.camera
    pivot = find_pivot(decision)
    layers = make_layers(decision, gripper, pivot)
    scene = {
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "pivot": pivot.tolist(),
        "up": way_up(decision.scene).tolist(),
        "closing": None if decision.grasp is None else decision.grasp.rotation[:, 0].tolist(),
        "layers": [layer.pack() for layer in layers],
    }
    parts = {
        "title": _text(f"{decision.instruction} · ThinkGrasp"),
        "status_color": _css(STATUS[decision.status]),
        "ramp": ", ".join(map(_css, SCORE_RAMP)),
        "panel": _panel(decision, {layer.name for layer in layers}),
        "scene": json.dumps(scene, allow_nan=False).replace("<", "\\u003c"),
        "script": files.joinpath("view.js").read_text("utf-8"),
    }
    template = files.joinpath("view.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda hole: parts[hole[1]], template)


def _base64(array: NDArray[np.generic], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array).astype(dtype).tobytes()).decode("ascii")


def find_pivot(decision: Decision) -> Float:
    """Return what the turntable turns about (3,): the preferred point, else the objects' middle, else everything's."""
    if decision.preferred_point is not None:
        return decision.preferred_point
    points = decision.scene.points
    valid = np.isfinite(points[..., 2])
    objects = object_mask(decision) & valid
    chosen = points[objects if objects.any() else valid]
    return np.median(chosen, axis=0).astype(np.float64) if len(chosen) else np.array([0.0, 0.0, 1.0])


def object_mask(decision: Decision) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of all proposals."""
    mask = np.zeros(decision.scene.points.shape[:2], bool)
    for proposal in decision.scene.proposals:
        mask |= proposal.mask
    return mask


def way_up(scene: Scene) -> Float:
    """Return the way up (3,) in the camera frame: from the support, else from the camera's pose, else the image's."""
    if scene.support is not None:
        return scene.support.normal
    if scene.frame.T_world_camera is not None:
        return scene.frame.T_world_camera[2, :3]
    return np.array([0.0, -1.0, 0.0])


def make_layers(decision: Decision, gripper: Gripper, pivot: Float) -> list[Layer]:
    """Return everything that can be shown of a decision, the cloud first."""
    layers, chosen = _cloud(decision), []
    if decision.scene.support is not None:
        layers.append(_plane(decision.scene.support, pivot))
    if decision.alternatives:
        layers.append(_candidates(decision.alternatives, gripper))
    if decision.grasp is not None:
        chosen = _chosen(decision.grasp, gripper)
    if decision.preferred_point is not None:
        corners = decision.preferred_point + POINT_RADIUS_M * np.array(
            [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64
        )
        faces = np.array([[i, j, k] for i in (0, 1) for j in (2, 3) for k in (4, 5)])
        layers.append(_triangles("point", [corners[face] for face in faces], [POINT] * 8))
    return layers + chosen


def _cloud(decision: Decision) -> list[Layer]:
    """Target, other objects and the rest, each with a share of the points that are left; thinned where it has more."""
    points, frame = decision.scene.points, decision.scene.frame
    valid = np.isfinite(points[..., 2])
    target = np.zeros_like(valid) if decision.target is None else decision.target.mask & valid
    objects = object_mask(decision) & valid & ~target
    left, layers = MAX_POINTS, []
    groups = (("target", target, 0.5), ("cloud", objects, 0.6), ("cloud", valid & ~target & ~objects, 1.0))
    for name, mask, share in groups:
        kept, step = thin(mask, int(share * left))
        left -= int(kept.sum())
        if kept.any():
            spacing = max(1.4 * step, 1.05 * float(np.ceil(step))) / frame.camera.fx
            layers.append(Layer(name, "points", points[kept], frame.color[kept], spacing, tintable=name == "target"))
    return layers


def thin(mask: NDArray[np.bool_], limit: int) -> tuple[NDArray[np.bool_], float]:
    """Keep at most `limit` pixels of a mask on a regular lattice; return them and the lattice's step [px]."""
    kept, step = mask, 1.0
    while (n := int(kept.sum())) > limit:
        step *= max(1.02, float(np.sqrt(n / max(limit, 1))))
        rows, columns = (np.isin(np.arange(size), (np.arange(size) * step).astype(int)) for size in mask.shape)
        kept = mask & rows[:, None] & columns
        if step > max(mask.shape):
            return np.zeros_like(mask), step
    return kept, step


def _plane(support: SupportPlane, pivot: Float) -> Layer:
    """A grid on the support around the pivot."""
    n = support.normal
    center = pivot - (float(n @ pivot) + support.offset_m - PLANE_LIFT_M) * n
    across = np.eye(3)[int(np.argmin(np.abs(n)))]
    across = across - (across @ n) * n
    across /= np.linalg.norm(across)
    along = np.cross(n, across)
    ticks = np.arange(-PLANE_REACH_M, PLANE_REACH_M + 1e-9, PLANE_STEP_M)
    ends = np.array([-PLANE_REACH_M, PLANE_REACH_M])
    lines = [center + a * u + b * v for u, v in ((across, along), (along, across)) for a in ticks for b in ends]
    vertices = np.array(lines)
    in_front = (vertices.reshape(-1, 2, 3)[..., 2] > 0.02).all(axis=1).repeat(2)
    vertices = vertices[in_front]
    return Layer("plane", "lines", vertices, np.full(vertices.shape, MUTED, np.uint8), alpha=0.5)


def _candidates(grasps: Sequence[Grasp], gripper: Gripper) -> Layer:
    """A thin glyph per grasp: two fingers, a bridge and a stem, coloured by score."""
    b, L = GLYPH_BAR_M / 2, gripper.finger_length_m
    quads: list[Float] = []
    colors: list[RGB] = []
    for grasp in grasps:
        h = grasp.width_m / 2
        bars = np.array(
            [
                [[-h - b, -b, -L], [-h + b, b, 0]],
                [[h - b, -b, -L], [h + b, b, 0]],
                [[-h, -b, -L - b], [h, b, -L + b]],
                [[-b, -b, -L - GLYPH_STEM_M], [b, b, -L]],
            ]
        )
        for bar in bars:
            quads += _box_quads(to_camera(grasp, box_corners(bar)))
        colors += [score_color(grasp.score)] * (6 * len(bars))
    return _triangles("candidates", quads, colors)


def _chosen(grasp: Grasp, gripper: Gripper) -> list[Layer]:
    """Solid fingers, a palm to look through, and the edges of all three."""
    corners = [to_camera(grasp, box_corners(body)) for body in gripper.bodies(grasp.width_m)]
    fingers = [quad for box in corners[:2] for quad in _box_quads(box)]
    palm = _box_quads(corners[2])
    edges = np.array([[a, b] for a in range(8) for b in range(8) if a < b and (a ^ b) in (1, 2, 4)])
    lines = np.concatenate([box[edges].reshape(-1, 3) for box in corners])
    return [
        _triangles("chosen", fingers, [GRIPPER] * len(fingers)),
        Layer("chosen", "lines", lines, np.full(lines.shape, EDGE, np.uint8)),
        replace(_triangles("chosen", palm, [GRIPPER] * len(palm)), alpha=0.3),
    ]


def _box_quads(corners: Float) -> list[Float]:
    return [corners[list(face)] for face in BOX_FACES]


def _triangles(name: str, polygons: Iterable[Float], colors: Sequence[RGB]) -> Layer:
    """Fan out convex polygons, each in its colour, darker where it faces sideways or away from the camera."""
    positions: list[Float] = []
    shades: list[NDArray[np.uint8]] = []
    for polygon, color in zip(polygons, colors, strict=True):
        normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        light = 0.62 + 0.38 * abs(float(normal @ np.array([0.30, 0.55, 0.78])))
        shade = np.round(np.array(color) * min(light, 1.0)).astype(np.uint8)
        for i in range(1, len(polygon) - 1):
            positions.append(polygon[[0, i, i + 1]])
            shades.append(np.broadcast_to(shade, (3, 3)))
    return Layer(name, "triangles", np.concatenate(positions), np.concatenate(shades))


def score_color(score: float) -> RGB:
    """Return the colour of a score 0..1 on the ramp; what lies outside counts as its end."""
    where = float(np.clip(np.nan_to_num(score), 0, 1)) * (len(SCORE_RAMP) - 1)
    low = min(int(where), len(SCORE_RAMP) - 2)
    mixed = np.array(SCORE_RAMP[low]) + (where - low) * np.subtract(SCORE_RAMP[low + 1], SCORE_RAMP[low])
    r, g, b = (round(float(c)) for c in mixed)
    return r, g, b


def _css(color: RGB) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def _text(text: str) -> str:
    """Escape text for HTML; halves of surrogate pairs and NUL, which no page may hold, become marks or vanish."""
    return escape(text.encode("utf-8", "replace").decode("utf-8").replace("\x00", ""))


def _panel(decision: Decision, shown: set[str]) -> str:
    """Everything that is said beside the picture, as HTML."""
    plan, target, grasp = decision.plan, decision.target, decision.grasp
    facts = [("Wanted", plan.target), ("Step", f"{plan.role}, {plan.kind}")]
    if target is not None:
        facts += [
            ("Target", target.label),
            ("Match", f"{target.score:.2f}"),
            ("Cell", f"{plan.cell} of {plan.grid} x {plan.grid}"),
        ]
    if grasp is not None:
        x, y, z = grasp.position
        facts += [
            ("Grasp score", f"{grasp.score:.2f}"),
            ("Opening", f"{grasp.width_m * 1e3:.0f} mm"),
            ("Position", f"{x:.3f}, {y:.3f}, {z:.3f} m"),
        ]
    sections = [
        f'<span class="status">{STATUS_TEXT[decision.status]}</span>',
        f'<h1 dir="auto">{_text(decision.instruction)}</h1>',
        f'<p dir="auto">{_text(plan.rationale)}</p>',
        "<dl>" + "".join(f'<dt>{name}</dt><dd dir="auto">{_text(value)}</dd>' for name, value in facts) + "</dl>",
        _toggles(decision, shown),
        _funnel(decision),
        _timings(decision),
    ]
    if decision.degraded:
        items = "".join(
            f"<li><b>{_text(d.stage)}</b>: {_text(d.reason)}; instead: {_text(d.fallback)}</li>"
            for d in decision.degraded
        )
        sections.append(f"<h2>Fallbacks taken</h2><ul>{items}</ul>")
    sections.append("<footer>Camera frame: x right, y down, z forward.</footer>")
    return "\n".join(s for s in sections if s)


def _toggles(decision: Decision, shown: set[str]) -> str:
    n = len(decision.alternatives)
    rows = (
        ("chosen", "Chosen grasp", '<span class="swatch" style="background:var(--gripper)"></span>'),
        ("candidates", f"Other candidates ({n})", '<span class="swatch ramp" title="score 0 to 1"></span>'),
        ("target", "Highlight target", '<span class="swatch" style="background:var(--target)"></span>'),
        ("point", "Preferred point", f'<span class="swatch" style="background:{_css(POINT)}"></span>'),
        ("plane", "Support plane (5 cm grid)", f'<span class="swatch" style="background:{_css(MUTED)}"></span>'),
    )
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}" checked>{text}{swatch}</label>'
        for name, text, swatch in rows
        if name in shown
    )
    return f"<h2>Show</h2>{boxes}" if boxes else ""


def _funnel(decision: Decision) -> str:
    if not decision.funnel:
        return ""
    first = max(decision.funnel[0].n_in, 1)
    rows = [(step.check, step.n_out) for step in decision.funnel]
    return "<h2>Candidates after each check</h2>" + _bars((name, str(n), n / first) for name, n in rows)


def _timings(decision: Decision) -> str:
    if not decision.timings_ms:
        return ""
    total = max(dict(decision.timings_ms).get("total", 0.0), 1e-9)
    return "<h2>Time</h2>" + _bars((name, f"{ms:.1f} ms", ms / total) for name, ms in decision.timings_ms)


def _bars(rows: Iterable[tuple[str, str, float]]) -> str:
    body = "".join(
        f"<tr{' class=total' if name == 'total' else ''}><th>{_text(name.replace('_', ' '))}</th>"
        f'<td class="bar"><i style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></i></td><td>{value}</td></tr>'
        for name, value, share in rows
    )
    return f"<table>{body}</table>"
