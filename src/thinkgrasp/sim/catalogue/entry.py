"""One row of the catalogue, and how it becomes an object of the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thinkgrasp.language import COLOR_NAMES
from thinkgrasp.language.knowledge import KnownObject, load_knowledge
from thinkgrasp.sim.catalogue import shapes
from thinkgrasp.sim.catalogue.printing import RGB, Picture
from thinkgrasp.sim.catalogue.solid import Solid
from thinkgrasp.sim.objects import Projection, SimObject, Texture, VisualPiece

SIZE_SPREAD = 0.04
"""A seed makes a thing larger or smaller by at most this share."""
SHADE_SPREAD = 0.05
"""A seed makes a thing lighter or darker by at most this share."""


@dataclass(frozen=True, eq=False)
class Part:
    """A named part of one material."""

    name: str
    solid: Solid
    color: RGB
    picture: Picture | None = None
    projection: Projection = "box"
    gloss: float = 0.2


Parts = tuple[Part, ...]
Build = Callable[[Generator], Parts]


@dataclass(frozen=True)
class Entry:
    """One kind of object."""

    name: str
    """A name or synonym of the household knowledge, or a colour before one."""
    category: str
    colors: tuple[str, ...]
    """Names of its colours, the one that covers most first."""
    mass_kg: float
    friction: float
    build: Build

    @property
    def known(self) -> KnownObject:
        """The household knowledge of this kind of thing."""
        color, _, rest = self.name.partition(" ")
        wanted = {self.name, rest} if color in COLOR_NAMES else {self.name}
        return next(o for o in load_knowledge().objects.values() if wanted & {o.name, *o.synonyms})

    def make(self, seed: int) -> SimObject:
        """Build it; the seed varies size, shade and print."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        size = 1 + SIZE_SPREAD * rng.uniform(-1, 1)
        shade = 1 + SHADE_SPREAD * rng.uniform(-1, 1)
        parts = self.build(rng)
        whole = [p.solid.surface for p in parts]
        shift = -1000 * shapes.volume_and_centroid(shapes.join(*whole))[1]
        placed = [(p, p.solid.at(*shift).scaled(size)) for p in parts]
        return SimObject(
            name=self.name,
            category=self.category,
            colors=self.colors,
            uses=self.known.uses,
            mass_kg=round(self.mass_kg * size**3, 4),
            friction=self.friction,
            visuals=tuple(_visual(part, solid, shade) for part, solid in placed),
            collisions=tuple(c for _, solid in placed for c in solid.collisions),
        )


def _visual(part: Part, solid: Solid, shade: float) -> VisualPiece:
    vertices, faces = solid.surface
    texture = None
    if part.picture is not None:
        image = np.clip(part.picture * shade, 0, 255).round().astype(np.uint8)
        texture = Texture(image, part.projection, np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    r, g, b = (float(min(1.0, shade * c / 255)) for c in part.color)
    return VisualPiece(part.name, vertices.astype(np.float32), faces.astype(np.int32), (r, g, b), texture, part.gloss)
