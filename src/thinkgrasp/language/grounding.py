"""Which of the things in view a query means: a score from 0 to 1 for every proposal, with reasons.

The only evidence is colour, shape, size and place. A thing that fits another name clearly better than the one asked
for loses in proportion; among several that fit, order decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.language.completion import stand_down
from thinkgrasp.language.evidence import ObjectFits, color_degree, fit_objects, knowledge_arrays, shape_degree
from thinkgrasp.language.knowledge import KnownObject, load_knowledge
from thinkgrasp.language.places import Layout
from thinkgrasp.language.wanted import Query, RelationWish, Wanted
from thinkgrasp.language.weights import DEFAULT_WEIGHTS, Weights
from thinkgrasp.types import Proposal, Scene

Float = NDArray[np.float64]

MIN_SCORE = DEFAULT_WEIGHTS.min_score
MIN_LANDMARK_SCORE = 0.3
NEAR_BEST = 0.55
"""Things with this share of the best score compete on place and size."""
MIN_RELATION = 0.12
"""Below this nobody would say that the relation holds."""
STANDS_OUT = 2.5
"""Ratio of the best score to the next from which on a thing stands out."""
SURE_FIT, SURE_LEAD = 0.8, 0.85
"""A thing nobody named is called by a name that fits this well, while no other comes near this share of it."""
EXPLAINED = (0.45, 0.6)
"""Between these fits another name begins to explain a thing, and does."""
NATURAL_FIT = 0.8
"""From here on a thing begins to be unmistakable that has its form and its colour from nature, as a banana."""
A_KIND_OF = 0.85
"""Weight of a special kind where the general name was said, so that usual colours of kinds do not decide."""
SECOND_USE = 0.75
"""Weight of a use that a thing serves, though others serve it better."""


@dataclass(frozen=True)
class Match:
    """One proposal's agreement with a query."""

    mark: int
    score: float
    label: str
    """A readable name such as "red box"."""
    reasons: tuple[str, ...] = ()
    name: str | None = None
    """The known object that it was taken for."""


@dataclass(frozen=True)
class Grounding:
    """All proposals by how well they answer to a query, best first."""

    matches: tuple[Match, ...]
    described: bool = False
    """Whether a colour or shape was said."""
    notes: tuple[str, ...] = ()
    """What could not be judged."""
    lone_share: float = DEFAULT_WEIGHTS.lone_described
    """Share of the least score that is enough for a described thing that stands out."""
    names_are_known: bool = False
    """Whether the labels name the things whatever their score."""

    def fitting(self, min_score: float = MIN_SCORE) -> tuple[Match, ...]:
        """Return the matches that answer to the query: those above the score, or else the one that stands out.

        A thing stands out when a colour or shape was said and no other comes near; then less than the score is enough.
        """
        good = tuple(m for m in self.matches if m.score >= min_score)
        if good or not self.matches:
            return good
        best, *rest = self.matches
        lone = not rest or rest[0].score * STANDS_OUT <= best.score
        return (best,) if self.described and lone and best.score >= self.lone_share * min_score else ()


def ground(scene: Scene, query: Query, weights: Weights = DEFAULT_WEIGHTS) -> Grounding:
    """Score every proposal of a scene against a query.

    Args:
        scene: Proposals with colours, shapes and sizes; obstruction edges say what rests on what.
        query: From `parse`.
        weights: How strictly words are held against what is seen.

    Returns:
        One match per proposal, best first; empty when the scene has none or nothing was understood.
    """
    things = scene.proposals
    if not things or not query.wanted:
        return Grounding(())
    view = _View(scene, weights)
    scored = [view.score(w) for w in query.wanted]
    total = np.stack([s.score for s in scored])
    best = total.argmax(axis=0)
    notes = [n for s in scored for n in s.notes]
    for unwanted in query.excluded:
        total = total * (1 - np.clip((view.score(unwanted).score - 0.3) / 0.3, 0, 1))
    matches = [
        Match(
            mark=p.mark,
            score=float(total[best[i], i]),
            label=view.label(i, query.wanted[best[i]], scored[best[i]]),
            reasons=tuple(scored[best[i]].reasons[i]),
            name=scored[best[i]].names[i],
        )
        for i, p in enumerate(things)
    ]
    matches.sort(key=lambda m: (-m.score, m.mark))
    described = any(w.colors or w.shapes for w in query.wanted)
    return Grounding(tuple(matches), described, tuple(dict.fromkeys(notes)), weights.lone_described)


def describe(proposal: Proposal) -> str:
    """Return a readable name from colour and shape alone, such as "white cylindrical object"."""
    color = proposal.colors[0][0] if proposal.colors and proposal.colors[0][1] > 0 else ""
    shape = proposal.shapes[0][0] if proposal.shapes and proposal.shapes[0][1] >= 0.4 else ""
    return " ".join(w for w in (color, shape, "object") if w)


def plain_names(scene: Scene) -> dict[int, str]:
    """Return a readable name per mark: the known object where only that one fits well, else colour and shape."""
    if not scene.proposals:
        return {}
    fits = fit_objects(stand_down(scene).proposals)
    likely = fits.all * knowledge_arrays().common[:, None]
    names: dict[int, str] = {}
    for i, p in enumerate(scene.proposals):
        best = int(likely[:, i].argmax())
        kin = _kin(frozenset([fits.names[best]]))
        rival = max((float(v) for n, v in zip(fits.names, likely[:, i], strict=True) if n not in kin), default=0.0)
        sure = likely[best, i] >= SURE_FIT and rival <= SURE_LEAD * likely[best, i]
        names[p.mark] = _colored(p, fits.names[best]) if sure else describe(p)
    return names


def _colored(proposal: Proposal, name: str) -> str:
    color = proposal.colors[0][0] if proposal.colors else ""
    return name if color in name.split() else f"{color} {name}".strip()


@lru_cache(maxsize=256)
def candidates(wanted: Wanted) -> dict[str, float]:
    """Return the known objects that answer to the noun of a wanted thing, with weights 0..1; empty without a noun."""
    knowledge = load_knowledge()
    if wanted.names:
        return {k: 1.0 if k == name else A_KIND_OF for name in wanted.names for k in knowledge.kinds_of(name)}
    found: dict[str, float] = {}
    for obj in knowledge.objects.values():
        in_category = not wanted.categories or any(c in obj.categories for c in wanted.categories)
        use = max(
            (1.0 if u in obj.uses else SECOND_USE if u in obj.second_uses else 0.0 for u in wanted.uses), default=1.0
        )
        if (wanted.categories or wanted.uses) and in_category and use > 0:
            found[obj.name] = use * obj.common
    if not found and wanted.categories and wanted.uses:
        return candidates(Wanted(categories=wanted.categories))
    return found


@dataclass(frozen=True, eq=False)
class _Scored:
    """Scores (P,) of one wanted thing, with reasons and the taken name per proposal."""

    score: Float
    reasons: list[list[str]]
    names: list[str | None]
    notes: list[str]


class _View:
    """One scene, measured once, against which several wanted things are scored."""

    def __init__(self, scene: Scene, weights: Weights) -> None:
        scene = stand_down(scene)
        self.weights = weights
        self.things = scene.proposals
        self.layout = Layout.of(scene)
        self.fits: ObjectFits = fit_objects(self.things, weights)
        self.index = {name: i for i, name in enumerate(self.fits.names)}
        k = knowledge_arrays()
        explained = (self.fits.all * k.common[:, None])[~k.featureless].max(axis=0, initial=0.0)
        low, high = EXPLAINED
        self.unexplained = 1 - 0.5 * np.clip((explained - low) / (high - low), 0, 1)
        """(P,) what is left of a name that has no features, the less the better another name explains the thing."""
        self.confidence = np.array([p.confidence for p in self.things])

    def score(self, wanted: Wanted) -> _Scored:
        n = len(self.things)
        out = _Scored(
            np.clip(self.confidence, 0.05, 1) ** self.weights.confidence, [[] for _ in range(n)], [None] * n, []
        )
        if wanted.has_noun:
            self._noun(wanted, out)
        if wanted.colors:
            each = np.array([[color_degree(p, c) for p in self.things] for c in wanted.colors])
            degree = each.max(axis=0) if wanted.any_color else 0.5 * each.mean(axis=0) + 0.5 * each.min(axis=0)
            degree = degree * np.minimum(degree / max(self.weights.said_color, 1e-6), 1)
            self._apply(out, "colour " + wanted.label_colors, degree)
        for shape in wanted.shapes:
            self._apply(out, shape, np.array([0.05 + 0.95 * shape_degree(p, shape) for p in self.things]))
        for size in wanted.sizes:
            self._apply(out, size, self._size(size, out.score))
        for view in wanted.views:
            leading = _leading(out.score)
            degree = self.layout.view_degree(view, leading)
            best = max(float(degree[leading].max(initial=0.0)), 1e-9)
            self._apply(out, f"at the {view}", 0.15 + 0.85 * np.minimum(degree / best, 1))
        for relation in wanted.relations:
            self._relation(relation, out)
        if wanted.superlative is not None:
            self._superlative(wanted, out)
        return out

    def label(self, i: int, wanted: Wanted, scored: _Scored) -> str:
        """Name proposal i: as it was asked for where that is a name, else by what it was taken for."""
        p = self.things[i]
        if wanted.names:
            return " ".join([*([wanted.label_colors] if wanted.colors else []), wanted.said])
        name = scored.names[i]
        color = wanted.label_colors or (p.colors[0][0] if p.colors else "")
        return f"{color} {name}".strip() if name and color not in name else name or describe(p)

    def _apply(self, out: _Scored, what: str, degree: Float) -> None:
        out.score[:] = out.score * degree
        for i, d in enumerate(degree):
            out.reasons[i].append(f"{what} {d:.2f}")

    def _noun(self, wanted: Wanted, out: _Scored) -> None:
        weights = candidates(wanted)
        rows = np.array([self.index[name] for name in weights])
        if not len(rows):
            out.score[:] = 0
            return
        with_color = not wanted.colors
        fits = self.fits.all if with_color else self.fits.form
        mine = fits[rows] * np.array(list(weights.values()))[:, None]
        if with_color and not wanted.shapes:
            featureless = knowledge_arrays().featureless[rows]
            mine = mine * np.where(featureless[:, None], self.unexplained, 1.0)
            if wanted.names and featureless.all():
                out.notes.append(f"neither a colour nor a shape is usual for {wanted.said!r}, say one to be sure")
        literal = np.array([1.15 if name in wanted.names else 1.0 for name in weights])
        best = (mine * literal[:, None]).argmax(axis=0)
        degree = mine.max(axis=0)
        others = np.array([i for name, i in self.index.items() if name not in _kin(frozenset(weights))], np.intp)
        likely = fits[others] * knowledge_arrays().common[others, None]
        rival = likely.max(axis=0, initial=0.0)
        rival_at = likely.argmax(axis=0) if len(others) else np.zeros(len(self.things), np.intp)
        w = self.weights
        doubt = w.rivalry if with_color and not wanted.shapes else w.rivalry_described
        share = (degree / np.maximum(np.maximum(degree, w.rival_discount * rival), 1e-9)) ** doubt
        if with_color:
            share = share * (1 - w.natural * self._natural(others))
        names = list(weights)
        for i, p in enumerate(self.things):
            out.names[i] = names[best[i]]
            out.reasons[i].append(
                f"{names[best[i]]} by {'colour, ' if with_color else ''}shape and size {degree[i]:.2f}"
            )
            if share[i] < 0.8:
                out.reasons[i].append(f"rather a {self.fits.names[others[rival_at[i]]]} {rival[i]:.2f}")
            out.reasons[i].append(f"{p.extents_m[0]:.2f} m long")
        out.score[:] = out.score * degree * share

    def _natural(self, others: NDArray[np.intp]) -> Float:
        """Return (P,) how surely a thing is one of these others that nature made in one form and colour."""
        own = others[knowledge_arrays().natural[others]]
        fit = self.fits.all[own].max(axis=0, initial=0.0)
        return np.clip((fit - NATURAL_FIT) / 0.1, 0, 1)

    def _size(self, size: str, score: Float) -> Float:
        lay = self.layout
        values = lay.size if size in ("small", "big") else lay.height
        among = values[_leading(score)] if (score > 0).any() else values
        ratio = np.log(np.maximum(values, 1e-3) / max(float(np.median(among)), 1e-3))
        if size in ("small", "short"):
            ratio = -ratio
        return 0.2 + 0.8 / (1 + np.exp(-5 * ratio - 1))

    def _superlative(self, wanted: Wanted, out: _Scored) -> None:
        key = wanted.superlative
        if key is None:
            return
        among = np.nonzero(_leading(out.score))[0]
        order = among[np.argsort(-self.layout.key(key.key)[among], kind="stable")]
        degree = np.full(len(self.things), 0.3)
        if key.rank <= len(order):
            degree[order[key.rank - 1]] = 1.0
        else:
            out.notes.append(f"only {len(order)} candidates for number {key.rank} {key.key}")
        self._apply(out, key.key if key.rank == 1 else f"number {key.rank} {key.key}", degree)

    def _relation(self, relation: RelationWish, out: _Scored) -> None:
        degrees: list[Float] = []
        scored = [self.score(landmark) for landmark in relation.landmarks]
        present = [s for s in scored if s.score.max(initial=0.0) >= MIN_LANDMARK_SCORE]
        if len(present) < len(scored):
            missing = [w.label for w, s in zip(relation.landmarks, scored, strict=True) if s not in present]
            out.notes.append(f"no {' and no '.join(missing)} in view to judge {relation.kind!r} by")
            self._apply(out, relation.kind, np.full(len(self.things), 0.7))
            return
        if relation.kind == "between":
            self._between(scored, out)
            return
        for s in scored:
            weight = s.score / s.score.max()
            each = [
                weight[j] ** 2 * self.layout.relation_degree(relation.kind, int(j))
                for j in np.nonzero(weight >= 0.6)[0]
                if s.score[j] >= MIN_LANDMARK_SCORE
            ]
            degrees.append(np.max(each, axis=0))
        what = f"{relation.kind} the {' and the '.join(w.label for w in relation.landmarks)}"
        self._apply_relation(out, what, np.min(degrees, axis=0))

    def _between(self, scored: list[_Scored], out: _Scored) -> None:
        if len(scored) == 1:
            pair = np.argsort(-scored[0].score, kind="stable")[:2]
            if len(pair) < 2:
                return
            a, b = int(pair[0]), int(pair[1])
        else:
            a, b = (int(s.score.argmax()) for s in scored[:2])
        self._apply_relation(out, "between", self.layout.between_degree(a, b))

    def _apply_relation(self, out: _Scored, what: str, degree: Float) -> None:
        """Apply a relation relative to the candidate that fulfils it best, as people choose among what is there."""
        best = float(degree[_leading(out.score)].max(initial=0.0))
        if best >= MIN_RELATION:
            degree = np.minimum(degree / best, 1) * (0.6 + 0.4 * min(1.0, 2 * best))
        self._apply(out, what, 0.05 + 0.95 * degree)


def _leading(score: Float) -> NDArray[np.bool_]:
    """Candidates (P,): those that come near to the best."""
    return score >= NEAR_BEST * max(float(score.max(initial=0.0)), 1e-9)


@lru_cache(maxsize=256)
def _kin(names: frozenset[str]) -> frozenset[str]:
    """The names themselves, what they are a kind of, and what no camera tells from them (same category and shape)."""
    knowledge = load_knowledge()
    wanted = [knowledge.objects[n] for n in names]

    def alike(other: KnownObject) -> bool:
        return any(
            w.name.endswith(f" {other.name}")
            or other.name in w.categories
            or (
                w.categories == other.categories and w.shapes == other.shapes and w.either_shapes == other.either_shapes
            )
            for w in wanted
        )

    return names | {o.name for o in knowledge.objects.values() if alike(o)}
