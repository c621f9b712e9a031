"""The obstruction graph as a small drawing: the numbered things where the camera saw them, and what is in whose way."""

from __future__ import annotations

import numpy as np

from thinkgrasp.types import Obstruction, Scene
from thinkgrasp.viz.glyphs import Float

WIDTH, HEIGHT = 360.0, 250.0
RADIUS = 13.0
MARGIN = 20.0
PUSHES = 80
"""Rounds of moving overlapping nodes apart."""

MEANING = {"rests_on": "rests on", "hides": "hides", "blocks": "blocks"}


def draw_graph(scene: Scene, target: int | None) -> str:
    """Return the graph as an SVG element; empty when nothing was proposed.

    An arrow goes from what has to go first to what it is in the way of.

    Args:
        scene: The proposals and the edges between them.
        target: The mark to highlight.
    """
    if not scene.proposals:
        return ""
    at = dict(zip((p.mark for p in scene.proposals), _places(scene), strict=True))
    pairs: dict[tuple[int, int], list[Obstruction]] = {}
    for edge in scene.obstructions:
        if edge.a in at and edge.b in at:
            pairs.setdefault((edge.a, edge.b), []).append(edge)
    arrows = "".join(
        _arrow(at[a], at[b], edges, bent=(b, a) in pairs, toward_target=b == target) for (a, b), edges in pairs.items()
    )
    nodes = "".join(
        f'<g class="node{" target" if mark == target else ""}"><circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS:g}"/>'
        f'<text x="{x:.1f}" y="{y:.1f}">{mark}</text></g>'
        for mark, (x, y) in at.items()
    )
    said = "; ".join(describe(edge) for edge in scene.obstructions) or "nothing is in the way of anything"
    return (
        f'<svg class="graph" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="Obstruction graph: {said}">'
        f"{arrows}{nodes}</svg>"
    )


def describe(edge: Obstruction) -> str:
    """Say an edge with its evidence."""
    return f"{edge.a} {MEANING[edge.relation]} {edge.b} ({evidence(edge)})"


def evidence(edge: Obstruction) -> str:
    """Say an edge's evidence: the shared border [px], the gap under what rests, or the room for a finger [mm]."""
    if edge.unit == "px":
        return f"{edge.evidence:.0f} px of its edge"
    millimetres = f"{abs(edge.evidence) * 1e3:.0f} mm"
    if edge.relation == "blocks":
        return f"{millimetres} of room"
    return f"gap {millimetres}" if edge.evidence >= 0 else f"sunk in {millimetres}"


def _places(scene: Scene) -> Float:
    """Centres (N, 2) of the nodes: those of the boxes in the image, moved apart where they overlap."""
    camera = scene.frame.camera
    boxes = np.array([p.box_xyxy for p in scene.proposals], np.float64)
    centers = (boxes[:, :2] + boxes[:, 2:]) / 2
    low, high = centers.min(axis=0), centers.max(axis=0)
    span = np.maximum(high - low, [camera.width / 8, camera.height / 8])
    room = np.array([WIDTH, HEIGHT]) - 2 * (MARGIN + RADIUS)
    at = np.array([WIDTH, HEIGHT]) / 2 + (centers - (low + high) / 2) / span * room
    for _ in range(PUSHES):
        apart = at[:, None] - at[None]
        distance = np.linalg.norm(apart, axis=2)
        near = (distance < 3.2 * RADIUS) & ~np.eye(len(at), dtype=bool)
        if not near.any():
            break
        # Nodes on the same spot part sideways, by their order.
        order = np.sign(np.arange(len(at))[:, None] - np.arange(len(at)))[..., None] * np.array([1.0, 0.3])
        apart = np.where(distance[..., None] < 1e-6, order, apart / np.maximum(distance, 1e-6)[..., None])
        at = at + (apart * (near * (3.2 * RADIUS - distance) / 4)[..., None]).sum(axis=1)
        at = at.clip(MARGIN, [WIDTH - MARGIN, HEIGHT - MARGIN])
    return at


def _arrow(start: Float, end: Float, edges: list[Obstruction], *, bent: bool, toward_target: bool) -> str:
    """A curved line with a head; the kind of its strongest relation decides how it is drawn."""
    along = end - start
    length = max(float(np.linalg.norm(along)), 1e-6)
    along = along / length
    side = np.array([-along[1], along[0]])
    bow = (0.22 if bent else 0.08) * length * side
    a, b = start + (RADIUS + 1) * along, end - (RADIUS + 3) * along
    middle = (start + end) / 2 + bow
    heading = b - middle
    heading /= max(float(np.linalg.norm(heading)), 1e-6)
    across = np.array([-heading[1], heading[0]])
    head = " ".join(f"{x:.1f},{y:.1f}" for x, y in (b, b - 7 * heading + 3.6 * across, b - 7 * heading - 3.6 * across))
    kind = min((e.relation for e in edges), key=list(MEANING).index)
    tip = b - 5 * heading
    return (
        f'<g class="edge {kind}{" hot" if toward_target else ""}"><title>{"; ".join(map(describe, edges))}</title>'
        f'<path d="M{a[0]:.1f} {a[1]:.1f}Q{middle[0]:.1f} {middle[1]:.1f} {tip[0]:.1f} {tip[1]:.1f}"/>'
        f'<polygon points="{head}"/></g>'
    )
