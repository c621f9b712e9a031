"""What the simulator needs to know of one object: how it looks, how it collides, and what it is.

Object frame: metres, z up as the thing stands or lies at rest, origin inside it. The camera sees `visuals`, physics
uses `collisions`; a part mask of the ground truth is the pixels of the visuals that carry the part's name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ContractError

Projection = Literal["box", "cylinder", "sphere"]
"""How a texture lies on a surface: on six faces, around z, or by longitude and latitude; scaled to `bounds_m`."""
PieceShape = Literal["box", "sphere", "cylinder", "capsule", "ellipsoid", "hull"]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image laid on a surface by its position in the object frame; no texture coordinates are needed.

    "box": each side of `bounds_m` carries the whole image, its rows running down (-z) on the upright sides and -y on
    top and bottom. "cylinder": columns run once around z, counter-clockwise seen from above, starting at -y; rows run
    down. "sphere": columns are longitude in the same way, rows latitude from the top.
    """

    image: NDArray[np.uint8]
    """(h, w, 3) RGB."""
    projection: Projection
    bounds_m: NDArray[np.float64]
    """(2, 3) corners of the box that the image is scaled to."""


@dataclass(frozen=True, eq=False)
class VisualPiece:
    """One surface that the camera sees, of one part and one material.

    Raises:
        ContractError: The arrays have another shape or type, or a face names a vertex that is not there.
    """

    part: str
    """"body", "handle", "blade", "rim", "cap", ..."""
    vertices: NDArray[np.float32]
    """(V, 3) [m] object frame."""
    faces: NDArray[np.int32]
    """(F, 3) counter-clockwise seen from outside."""
    color: tuple[float, float, float]
    """sRGB 0..1; what shows where there is no texture."""
    texture: Texture | None = None
    gloss: float = 0.2
    """0 = matt, 1 = polished."""

    def __post_init__(self) -> None:
        V, F = self.vertices, self.faces
        if V.ndim != 2 or V.shape[1] != 3 or V.dtype != np.float32 or not np.isfinite(V).all():
            raise ContractError(
                f"visual {self.part!r}: vertices must be finite (V, 3) float32, got {V.shape} {V.dtype}"
            )
        if F.ndim != 2 or F.shape[1] != 3 or F.dtype != np.int32 or len(F) == 0:
            raise ContractError(f"visual {self.part!r}: faces must be (F, 3) int32, F > 0, got {F.shape} {F.dtype}")
        if F.min() < 0 or F.max() >= len(V):
            raise ContractError(f"visual {self.part!r}: faces name vertices {F.min()}..{F.max()} of {len(V)}")


@dataclass(frozen=True, eq=False)
class CollisionPiece:
    """One convex body.

    `size_m` is MuJoCo's: half sides of a box, (radius,) of a sphere, (radius, half length) of cylinder and capsule
    along their z, half axes of an ellipsoid; empty for a hull, whose `points_m` (P, 3) are in the object frame.
    """

    shape: PieceShape
    size_m: tuple[float, ...] = ()
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    points_m: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class SimObject:
    """One thing that can be put into a scene.

    Raises:
        ContractError: Nothing to see, nothing to touch, or a mass or friction that is not positive.
    """

    name: str
    """What a person calls it, unique among kinds: "cracker box"; a name of the household knowledge where it has one."""
    category: str
    colors: tuple[str, ...]
    uses: tuple[str, ...]
    mass_kg: float
    friction: float
    """Coulomb coefficient against the finger pads and the table."""
    visuals: tuple[VisualPiece, ...]
    collisions: tuple[CollisionPiece, ...]
    source: str = "catalogue"
    """"catalogue", or the folder that it was read from."""

    def __post_init__(self) -> None:
        if not self.visuals or not self.collisions:
            raise ContractError(f"object {self.name!r} needs at least one visual and one collision piece")
        if not (0 < self.mass_kg < 50 and 0 < self.friction < 5):
            raise ContractError(
                f"object {self.name!r}: mass must lie in (0, 50) kg and friction in (0, 5), "
                f"got {self.mass_kg} kg and {self.friction}"
            )

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts, in the order of the visuals, each once."""
        return tuple(dict.fromkeys(v.part for v in self.visuals))

    @property
    def bounds_m(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner of all visuals in the object frame."""
        points = np.concatenate([v.vertices for v in self.visuals]).astype(np.float64)
        return np.stack([points.min(axis=0), points.max(axis=0)])
