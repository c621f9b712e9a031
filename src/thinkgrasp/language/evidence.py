"""How well a thing's colours, shape and size agree with a word: degrees from 0 to 1, no network.

Two scales are used. What is usually so ("bananas are yellow") is judged mildly; what was said ("the yellow one") is
judged strictly. Sizes from a single view come out too small more often than too large, and are judged accordingly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.language import COLOR_NAMES, SHAPE_NAMES
from thinkgrasp.language.knowledge import Knowledge, KnownObject, load_knowledge
from thinkgrasp.language.vocabulary import load_vocabulary
from thinkgrasp.language.wanted import ColorWish
from thinkgrasp.language.weights import DEFAULT_WEIGHTS, Weights
from thinkgrasp.types import Proposal

Float = NDArray[np.float64]

SEEN_AS = {"cylindrical": ("round",), "round": ("cylindrical",), "box-like": ("elongated", "flat")}
"""What a shape may also look like from one side: a can from above is round, a box from its edge is long."""
ROUND, CYLINDRICAL, HOLLOW = (SHAPE_NAMES.index(s) for s in ("round", "cylindrical", "hollow"))
SHAPELESS = np.array([0.35, 0.6, 0.6, 0.4, 0.3, 0.45])
"""What is left of an expected shape, per descriptor, where the view shows no clear shape at all.

Long, flat and ball-shaped things show it from nearly every side; a can or a box that is seen in part may not.
"""
MISSED_SHAPE = np.array([0.3, 0.4, 0.4, 0.35, 0.25, 0.4])
"""The same where the view shows another shape."""
LATER_CHOICE = 0.25
"""What each place in a list of alternative shapes takes away."""
UNEXPECTED_SHAPE = np.array([0.35, 0.35, 0.35, 0.3, 0.35, 0.5])
"""What an unexpected shape takes away, per descriptor; a hollow is rarely seen where there is none."""
UNSEEN_FOOT_M = 0.02
STANDING = 0.6
"""What a thing that never stands on its end loses where one does."""
IRREGULAR_FIT = (0.75, 0.6)
"""How well a thing that has no regular shape fits where none is seen, and where a clear one is seen."""


CHROMATIC = tuple(c for c in COLOR_NAMES if c not in ("black", "white", "grey"))

_NEIGHBOURS: dict[str, dict[str, float]] = {
    "red": {"pink": 0.25, "orange": 0.3, "brown": 0.15},
    "orange": {"red": 0.4, "yellow": 0.2, "brown": 0.25},
    "yellow": {"orange": 0.3, "green": 0.15, "brown": 0.1},
    "green": {"blue": 0.2, "yellow": 0.15},
    "blue": {"green": 0.15, "purple": 0.25},
    "purple": {"blue": 0.12, "pink": 0.3},
    "pink": {"red": 0.12, "purple": 0.25},
    "brown": {"orange": 0.3, "red": 0.15, "yellow": 0.1, "black": 0.15},
    "black": {"grey": 0.3},
    "white": {"grey": 0.4},
    "grey": {"white": 0.3, "black": 0.3},
}
"""Share of a neighbouring colour's pixels that may be this colour, moved there by light or shade."""

_SHADED = np.eye(len(COLOR_NAMES)) + np.array(
    [[_NEIGHBOURS[mine].get(seen, 0.0) for mine in COLOR_NAMES] for seen in COLOR_NAMES]
)
"""(11, 11) seen colour to the colours that it may be."""


@dataclass(frozen=True, eq=False)
class KnowledgeArrays:
    """The household knowledge as arrays over N objects."""

    names: tuple[str, ...]
    colors: Float
    """(N, 11) 1 for the most usual colour, less for the next ones, 0 for unusual ones."""
    n_colors: Float
    """(N,) number of usual colours; 0 = any."""
    required: Float
    """(N, 6) 1 where the shape is expected."""
    either: Float
    """(N, 6) above 0 where the shape is one of those of which at least one is expected; 1 for the most usual."""
    unexpected: Float
    """(N, 6) 1 where the shape is neither expected nor optional."""
    longest_m: Float
    """(N, 2)"""
    middle_m: Float
    """(N, 2)"""
    shortest_m: Float
    """(N, 2)"""
    rise: Float
    """(N, 2)"""
    lies: Float
    """(N,) 1 for what does not stand on its end."""
    featureless: NDArray[np.bool_]
    """(N,) neither colour nor shape is usual: only size speaks for it."""
    natural: NDArray[np.bool_]
    """(N,) a common fruit or vegetable in one or two colours, not ball-shaped: nothing else looks like it."""
    common: Float
    """(N,) how usual each object is."""


@lru_cache(maxsize=1)
def knowledge_arrays() -> KnowledgeArrays:
    """Return the arrays of the knowledge that ships with the package."""
    return _arrays(load_knowledge())


def _arrays(knowledge: Knowledge) -> KnowledgeArrays:
    objects = tuple(knowledge.objects.values())
    colors = np.array([[_usualness(o, c) for c in COLOR_NAMES] for o in objects])
    required = np.array([[s in o.shapes for s in SHAPE_NAMES] for o in objects], float)
    either = np.array([[_choice(o, s) for s in SHAPE_NAMES] for o in objects], float)
    optional = np.array([[s in o.optional_shapes for s in SHAPE_NAMES] for o in objects], float)
    expected = np.maximum(required, either > 0)
    from_one_view = np.zeros_like(required)
    for shape, looks in SEEN_AS.items():
        has = expected[:, [SHAPE_NAMES.index(shape)]]
        from_one_view = np.maximum(from_one_view, has * [look in looks for look in SHAPE_NAMES])
    return KnowledgeArrays(
        names=tuple(o.name for o in objects),
        colors=colors,
        n_colors=(colors > 0).sum(axis=1).astype(float),
        required=required,
        either=either,
        unexpected=1 - np.maximum.reduce([expected, optional, from_one_view]),
        longest_m=np.array([o.longest_m for o in objects]),
        middle_m=np.array([o.middle_m for o in objects]),
        shortest_m=np.array([o.shortest_m for o in objects]),
        rise=np.array([o.rise for o in objects]),
        lies=np.array([float(o.lies) for o in objects]),
        featureless=np.array([not (o.colors or o.shapes or o.either_shapes) for o in objects]),
        natural=np.array([_natural(o) for o in objects]),
        common=np.array([o.common for o in objects]),
    )


def _natural(obj: KnownObject) -> bool:
    grown = "fruit" in obj.categories or "vegetable" in obj.categories
    return grown and 1 <= len(obj.colors) <= 2 and "round" not in obj.shapes and obj.common == 1


def _choice(obj: KnownObject, shape: str) -> float:
    return 1 - LATER_CHOICE * obj.either_shapes.index(shape) if shape in obj.either_shapes else 0.0


def _usualness(obj: KnownObject, color: str) -> float:
    return max(0.5, 1 - 0.1 * obj.colors.index(color)) if color in obj.colors else 0.0


@dataclass(frozen=True, eq=False)
class ObjectFits:
    """How well P proposals fit N known objects."""

    names: tuple[str, ...]
    form: Float
    """(N, P) shape and size together."""
    color: Float
    """(N, P) usual colours."""

    @property
    def all(self) -> Float:
        """(N, P) form and colour."""
        return self.form * self.color


def fit_objects(proposals: Sequence[Proposal], weights: Weights = DEFAULT_WEIGHTS) -> ObjectFits:
    """Judge every proposal against every known object.

    Args:
        proposals: P things.
        weights: How strictly.

    Returns:
        Degrees (N, P) in 0..1.
    """
    k = knowledge_arrays()
    colors = np.array([[p.color_share(c) for c in COLOR_NAMES] for p in proposals]).reshape(-1, len(COLOR_NAMES))
    shapes = np.array([[p.shape_degree(s) for s in SHAPE_NAMES] for p in proposals]).reshape(-1, len(SHAPE_NAMES))
    extents = np.array([p.extents_m for p in proposals]).reshape(-1, 3)

    shapes = np.clip(shapes, 0, 1)
    clear = shapes.max(axis=1, initial=0.0)[:, None]
    missed = (SHAPELESS + (MISSED_SHAPE - SHAPELESS) * clear) ** weights.missing_shape
    degree = missed + (1 - missed) * shapes
    has_choice = k.either.any(axis=1)
    n_required = k.required.sum(axis=1) + has_choice
    choice = (k.either[:, None, :] * degree[None]).max(axis=2)
    seen = (k.required @ degree.T + choice) / np.maximum(n_required, 1)[:, None]
    odd_shape = (k.unexpected[:, None, :] * shapes[None]).max(axis=2, initial=0.0)
    irregular = IRREGULAR_FIT[0] + (IRREGULAR_FIT[1] - IRREGULAR_FIT[0]) * odd_shape
    shape = np.where(n_required[:, None] > 0, seen, irregular)
    takes = np.minimum(weights.unexpected_shape * UNEXPECTED_SHAPE, 0.9)
    shape = shape * np.exp(k.unexpected @ np.log(1 - takes * shapes).T)
    ball = (k.required[:, ROUND] > 0) & (k.unexpected[:, CYLINDRICAL] == 0) & (k.either[:, CYLINDRICAL] == 0)
    more_can_than_ball = np.clip(shapes[:, CYLINDRICAL] - shapes[:, ROUND], 0, 1)
    shape = shape * (1 - ball[:, None] * UNEXPECTED_SHAPE[CYLINDRICAL] * more_can_than_ball)
    can = (k.required[:, CYLINDRICAL] > 0) | ((k.either[:, CYLINDRICAL] > 0) & (k.either[:, HOLLOW] == 0))
    can &= (k.required[:, ROUND] == 0) & (k.either[:, ROUND] == 0)
    shape = shape * (1 - 0.6 * can[:, None] * np.clip(shapes[:, ROUND] - shapes[:, CYLINDRICAL], 0, 1))
    slack = max(weights.size_slack, 1e-3)
    size = _within(extents[:, 0], k.longest_m, 0.45 * slack, 0.25 * slack)
    size = size * _within(extents[:, 1], k.middle_m, 0.6 * slack, 0.35 * slack)
    size = size * _within(extents[:, 2], k.shortest_m, 0.8 * slack, 0.42 * slack)
    slender = k.shortest_m / np.maximum(k.longest_m, 1e-3)
    slender = np.stack([slender.min(axis=1) / 1.2, slender.max(axis=1) * 1.2], axis=1)
    size = size * _within(extents[:, 2] / np.maximum(extents[:, 0], 1e-3), slender, 0.6 * slack, 0.6 * slack)
    upright = np.array([_stands(p) for p in proposals])
    size = size * (1 - STANDING * k.lies[:, None] * upright)
    rise = np.array([_rise(p) for p in proposals])
    open_top = np.clip(shapes[:, HOLLOW] / 0.5, 0, 1)
    size = size * (1 - open_top + open_top * _within(rise, k.rise, 0.4 * slack, 0.4 * slack))
    odd, indifferent = weights.odd_color_fit, weights.any_color_fit
    usual = odd + (1 - odd) * np.clip((k.colors @ (colors @ _SHADED).T - 0.05) / 0.6, 0, 1)
    telling = np.maximum(1 - 0.05 * np.maximum(k.n_colors - 1, 0), indifferent)
    color = np.where(k.n_colors[:, None] == 0, indifferent, usual * telling[:, None])
    return ObjectFits(k.names, shape * size, color)


def _rise(proposal: Proposal) -> float:
    """Return the height over the middle side; the lowest few centimetres are often not seen."""
    low, high = proposal.height_m
    return (high - (low if low > UNSEEN_FOOT_M else 0.0)) / max(proposal.extents_m[1], 1e-3)


def _stands(proposal: Proposal) -> float:
    """Return how far a long thing stands on its end, 0..1."""
    longest, _, shortest = proposal.extents_m
    rise = (proposal.height_m[1] - max(proposal.height_m[0], 0.0)) / max(longest, 1e-3)
    return float(np.clip((rise - 0.6) / 0.3, 0, 1)) if longest > 1.5 * shortest else 0.0


def _within(side_m: Float, range_m: Float, below: float, above: float) -> Float:
    """Degree (N, P) to which sides (P,) lie in ranges (N, 2); `below` and `above` are tolerances of the log ratio."""
    log = np.log(np.maximum(side_m, 1e-3))[None, :]
    low, high = np.log(np.maximum(range_m, 1e-3)).T[..., None]
    short = np.maximum(low - log - 0.1, 0) / below
    long = np.maximum(log - high - 0.05, 0) / above
    return np.exp(-(short**2) - long**2)


def color_degree(proposal: Proposal, wish: ColorWish) -> float:
    """Return how far a proposal has a colour that was said, 0..1; dark X accepts black, light X white shares."""
    names = load_vocabulary().colors[wish.word]
    share = 0.0
    for rank, name in enumerate(names):
        own = proposal.color_share(name)
        near = sum(w * proposal.color_share(n) for n, w in _NEIGHBOURS[name].items())
        share += max(1 - 0.2 * rank, 0.4) * own + (0.5 if rank else 1.0) * near
    hue = sum(proposal.color_share(n) for n in names)
    if wish.tone == "dark":
        share += (0.7 if hue > 0.04 else 0.35) * proposal.color_share("black")
    elif wish.tone == "light":
        share += (0.6 if hue > 0.04 else 0.2) * proposal.color_share("white")
    near_names = {n for name in names for n in _NEIGHBOURS[name]}
    degree = min(1.0, 1.3 * share / (share + 0.3))
    rival = max((proposal.color_share(n) for n in CHROMATIC if n not in names and n not in near_names), default=0.0)
    return degree * (0.5 + 0.5 * hue / rival) if 0 < hue < rival else degree


def shape_degree(proposal: Proposal, shape: str) -> float:
    """Return how far a proposal has a shape that was said, 0..1; seen from above a can is round too."""
    degree = proposal.shape_degree(shape)
    longest, middle, shortest = proposal.extents_m
    if shape == "round":
        compact = shortest / max(longest, 1e-6)
        degree = max(degree, 0.6 * proposal.shape_degree("cylindrical") * min(1.0, 1.6 * compact))
    elif shape == "flat":
        degree = max(degree, 1 - min(1.0, shortest / max(0.35 * middle, 1e-6)))
    elif shape == "elongated":
        degree = max(degree, min(1.0, max(0.0, (longest / max(middle, 1e-6) - 1.5) / 2)))
    return float(np.clip(degree, 0.0, 1.0))
