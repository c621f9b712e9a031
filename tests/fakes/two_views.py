"""A table seen from the front and from behind, and both views fused: what each camera hides from the other."""

from __future__ import annotations

from functools import cache

from fakes.tables import BLUE, GREEN, RED, view

from thinkgrasp.fusion import fuse
from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.types import Frame, Proposal, Scene

FRONT, BACK = (0.0, -0.5, 0.45), (0.05, 0.6, 0.45)
BOX_M = (0.10, 0.05, 0.10)
BEHIND_M = (0.05, 0.04, 0.05)


@cache
def frames() -> tuple[Frame, Frame]:
    """A red box, a blue one touching its back, hidden from the front, and a green can beside."""
    things = (
        t.box("red", BOX_M, RED, t.pose(-0.05, 0.0)),
        t.box("behind", BEHIND_M, BLUE, t.pose(-0.05, (BOX_M[1] + BEHIND_M[1]) / 2)),
        t.can("can", 0.03, 0.09, GREEN, t.pose(0.10, 0.0)),
    )
    front, back = (view(*things, eye=eye, size=(320, 240)).frame for eye in (FRONT, BACK))
    return front, back


@cache
def scene() -> Scene:
    return GeometricPerception().perceive(fuse(frames()))


def thing(scene: Scene, color: str) -> Proposal:
    return max(scene.proposals, key=lambda p: p.color_share(color))
