"""Where things are to each other and in the view: left, behind, next to, on, between, the biggest.

Left and right are those of the image. Depth is measured along the support, away from the camera; where the camera
looks straight down, farther up in the image counts as farther.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Scene

Float = NDArray[np.float64]

NEAR_M = 0.11
"""Gap between two things at which "next to" has dropped to about a third."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the P proposals of a scene are; x right, y away from the camera along the support, z up [m]."""

    position: Float
    """(P, 3) centres."""
    image: Float
    """(P, 2) box centres (u, v) [px]."""
    boxes: Float
    """(P, 4) boxes [px]."""
    radius: Float
    """(P,) half of the mean horizontal side [m]."""
    size: Float
    """(P,) root of the product of the two longest sides [m]."""
    longest: Float
    """(P,) [m]"""
    height: Float
    """(P,) from lowest to highest point [m]."""
    top: Float
    """(P,) highest point above the support [m]."""
    bottom: Float
    """(P,) lowest point above the support [m]."""
    distance: Float
    """(P,) from the camera [m]."""
    flatness: Float
    """(P,) 1 - shortest / longest."""
    roundness: Float
    """(P,)"""
    rests_on: NDArray[np.bool_]
    """(P, P) row rests on column."""
    hidden_by: NDArray[np.bool_]
    """(P, P) column hides row."""

    @classmethod
    def of(cls, scene: Scene) -> Layout:
        """Measure the proposals of a scene."""
        things = scene.proposals
        n = len(things)
        up = scene.support.normal if scene.support is not None else np.array([0.0, -1.0, 0.0])
        right = np.array([1.0, 0.0, 0.0]) - up[0] * up
        right /= max(float(np.linalg.norm(right)), 1e-6)
        axes: Float = np.stack([right, np.cross(up, right), up]).astype(np.float64)
        centers = np.array([p.center_m for p in things]).reshape(n, 3)
        boxes = np.array([p.box_xyxy for p in things], float).reshape(n, 4)
        extents = np.array([p.extents_m for p in things]).reshape(n, 3)
        heights = np.array([p.height_m for p in things]).reshape(n, 2)
        upright = np.ptp(heights, axis=1)
        index = {p.mark: i for i, p in enumerate(things)}
        rests, hidden = np.zeros((n, n), bool), np.zeros((n, n), bool)
        for e in scene.obstructions:
            if e.a in index and e.b in index:
                if e.relation == "rests_on":
                    rests[index[e.a], index[e.b]] = True
                elif e.relation == "hides":
                    hidden[index[e.b], index[e.a]] = True
        flat = np.sort(extents, axis=1)
        return cls(
            position=centers @ axes.T,
            image=(boxes[:, :2] + boxes[:, 2:]) / 2,
            boxes=boxes,
            radius=extents[:, :2].mean(axis=1) / 2,
            size=np.sqrt(extents[:, 0] * extents[:, 1]),
            longest=extents[:, 0],
            height=upright,
            top=heights[:, 1],
            bottom=heights[:, 0],
            distance=np.linalg.norm(centers, axis=1),
            flatness=1 - flat[:, 0] / np.maximum(flat[:, 2], 1e-6),
            roundness=np.array([p.shape_degree("round") for p in things]),
            rests_on=rests,
            hidden_by=hidden,
        )

    def key(self, superlative: str) -> Float:
        """Return (P,) values of which the largest answers to the superlative."""
        values = {
            "smallest": -self.size,
            "biggest": self.size,
            "tallest": self.height,
            "shortest": -self.height,
            "longest": self.longest,
            "leftmost": -self.image[:, 0],
            "rightmost": self.image[:, 0],
            "nearest": -self.distance,
            "farthest": self.distance,
            "topmost": self.top,
            "roundest": self.roundness,
            "flattest": self.flatness,
        }
        return values[superlative]

    def view_degree(self, view: str, candidates: NDArray[np.bool_]) -> Float:
        """Return (P,) how far each thing is left, right, middle, front or back among the candidates (P,)."""
        along = self.image[:, 0] if view in ("left", "right", "middle") else self.position[:, 1]
        among = along[candidates] if candidates.any() else along
        low, high = float(among.min()), float(among.max())
        if high - low < 1e-6:
            return np.ones(len(along))
        t = np.clip((along - low) / (high - low), 0, 1)
        if view in ("left", "front"):
            return 1 - t
        return t if view in ("right", "back") else 1 - np.abs(2 * t - 1)

    def relation_degree(self, kind: str, landmark: int) -> Float:
        """Return (P,) how far each thing stands in a relation to the thing with index `landmark`; 0 for itself."""
        step = self.position - self.position[landmark]
        flat_distance = np.linalg.norm(step[:, :2], axis=1)
        gap = np.maximum(flat_distance - self.radius - self.radius[landmark], 0)
        reach = np.exp(-flat_distance / 0.5)
        du = (self.image[:, 0] - self.image[landmark, 0]) / max(self._width(landmark), 1.0)
        sideways = np.exp(-((step[:, 0] / (self.radius[landmark] + 0.10)) ** 2))
        in_line = np.exp(-((step[:, 1] / 0.25) ** 2))
        if kind == "next to":
            degree = np.exp(-((gap / NEAR_M) ** 2)) * (0.7 + 0.3 * np.exp(-gap / 0.02))
        elif kind == "far from":
            degree = 1 - np.exp(-((gap / (3 * NEAR_M)) ** 2))
        elif kind in ("behind", "in front of"):
            away = step[:, 1] if kind == "behind" else -step[:, 1]
            degree = np.clip(away / 0.06, 0, 1) * sideways * reach
        elif kind in ("left of", "right of"):
            away = -du if kind == "left of" else du
            degree = np.clip(2 * away, 0, 1) * in_line * reach
        elif kind == "on":
            degree = np.maximum(self.rests_on[:, landmark], 0.8 * self._above(landmark))
        elif kind == "under":
            below = np.array([self._above(i)[landmark] for i in range(len(self.top))])
            degree = np.maximum(self.rests_on[landmark], 0.8 * below)
            degree = np.maximum(degree, 0.6 * self.hidden_by[:, landmark])
        else:
            degree = self._inside(landmark)
        degree = np.asarray(degree, float)
        degree[landmark] = 0.0
        return degree

    def between_degree(self, a: int, b: int) -> Float:
        """Return (P,) how far each thing lies between two others; 0 for those."""
        start, span = self.position[a, :2], self.position[b, :2] - self.position[a, :2]
        length = max(float(np.linalg.norm(span)), 1e-6)
        t = (self.position[:, :2] - start) @ span / length**2
        off = np.linalg.norm(self.position[:, :2] - start - t[:, None] * span, axis=1)
        degree = np.clip(1.6 - 2.4 * np.abs(t - 0.5), 0, 1) * np.exp(-((off / (0.35 * length + 0.03)) ** 2))
        degree[[a, b]] = 0.0
        return degree

    def _width(self, i: int) -> float:
        return float(self.boxes[i, 2] - self.boxes[i, 0])

    def _above(self, landmark: int) -> Float:
        step = np.linalg.norm(self.position[:, :2] - self.position[landmark, :2], axis=1)
        over = step < self.radius[landmark] + 0.3 * self.radius
        return (over & (self.bottom > self.top[landmark] - 0.025) & (self.top[landmark] > 0.005)).astype(float)

    def _inside(self, landmark: int) -> Float:
        x0, y0, x1, y1 = self.boxes[landmark]
        u, v = self.image.T
        held = (u > x0) & (u < x1) & (v > y0) & (v < y1) & (self.size < self.size[landmark])
        step = np.linalg.norm(self.position[:, :2] - self.position[landmark, :2], axis=1)
        return held * np.exp(-((step / max(self.radius[landmark], 1e-3)) ** 2))
