"""A planner without any model: words, household knowledge, and what depth says about the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

from scipy import ndimage

from thinkgrasp.errors import ConfigError
from thinkgrasp.language.evidence import knowledge_arrays
from thinkgrasp.language.grounding import (
    MIN_SCORE,
    Grounding,
    Match,
    candidates,
    ground,
    plain_names,
)
from thinkgrasp.language.knowledge import KnownObject, Part, load_knowledge
from thinkgrasp.language.query import parse
from thinkgrasp.language.vocabulary import load_vocabulary
from thinkgrasp.language.wanted import Query, Wanted
from thinkgrasp.memory import Memory
from thinkgrasp.planners.cells import CellChoice, Outline, choose_cell, part_region
from thinkgrasp.planners.clearing import Hider, Way, likely_hider, next_to_clear, way_to
from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Degradation, Mask, Obstruction, Plan, PlanKind, PlannedObject, Proposal, Scene

FAILURE_PENALTY = 0.7
"""Factor on a match's score per failed attempt at it."""
CLOSE_SCORE = 0.85
"""Among matches this close to the best one, a free one is taken before an obstructed one."""
BORDER_SHARE = 1.2
"""What the image border or the workspace edge cuts has to answer this much better than the least score."""
MAX_LISTED = 8

Search = Literal["piles", "anywhere", "all"]
Grounder = Callable[[Scene, Query], Grounding]


class OfflinePlanner:
    """Choose what to take, where, and why, from a sentence and a perceived scene; deterministic.

    Args:
        grid: Cells per side of the target's box.
        min_score: A thing that answers to the instruction less than this is no match.
        max_width_m: Gripper opening that grasp scores are judged by [m].
        search: Where a goal that is not seen is looked for: in piles only; behind tall things that stand free too
            ("anywhere"); or by clearing whatever is left ("all"), for a loop that is told the goal is there.
        ground: What scores the things in view against the words.

    Raises:
        ConfigError: A setting is out of range.
    """

    def __init__(
        self,
        *,
        grid: int = 3,
        min_score: float = MIN_SCORE,
        max_width_m: float = 0.085,
        search: Search = "piles",
        ground: Grounder = ground,
    ) -> None:
        if not 1 <= grid <= 15:
            raise ConfigError(f"offline planner: grid must be within 1..15, got {grid}")
        if not 0 < min_score < 1:
            raise ConfigError(f"offline planner: min_score must lie in (0, 1), got {min_score}")
        if not 0 < max_width_m < 1:
            raise ConfigError(f"offline planner: max_width_m must lie in (0, 1) m, got {max_width_m}")
        if search not in get_args(Search):
            raise ConfigError(f"offline planner: search must be one of {', '.join(get_args(Search))}, got {search!r}")
        self.grid = grid
        self.search = search
        self.min_score = min_score
        self.max_width_m = max_width_m
        self._ground = ground

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Choose the goal or what is in its way; `found` is False where nothing in view fits or can hide it."""
        query = parse(instruction)
        if not scene.proposals:
            reason = "no object proposals (the scene holds nothing above the support, or the scene stage is off)"
            return self._nothing(query, f"{reason}; this planner chooses among proposals")
        if not query.understood:
            listed = f" ({_quoted(query.unknown)})" if query.unknown else ""
            reason = f"the instruction names nothing that I understand{listed}"
            return self._nothing(query, f"{reason}; in view: {self._in_view(scene)}")
        grounding = self._ground(scene, query)
        worn_out = {p.mark for p in scene.proposals if memory.is_worn_out(p)}
        sure = [m for m in grounding.fitting(self.min_score) if self._is_sure(scene.proposal(m.mark), scene, m)]
        fitting = _failures_last(sure, scene, memory)
        goal = _goal([m for m in fitting if m.mark not in worn_out], scene, worn_out)
        if goal is None:
            return self._search(scene, query, grounding, fitting, memory, worn_out)
        way = way_to(scene, goal.mark, worn_out)
        if way.first == goal.mark:
            return self._take_goal(scene, query, grounding, goal, memory)
        return self._clear(scene, query, grounding, goal, way, memory)

    def _is_sure(self, thing: Proposal, scene: Scene, match: Match) -> bool:
        """Whether a match holds although something may cut the thing off."""
        return match.score >= BORDER_SHARE * self.min_score or not _is_cut(thing, scene)

    def _take_goal(self, scene: Scene, query: Query, grounding: Grounding, goal: Match, memory: Memory) -> Plan:
        thing = scene.proposal(goal.mark)
        spot = _spot(scene, thing, self.grid, _wanted_part(query, goal), goal.name, memory)
        because = "; ".join(goal.reasons) or "any will do"
        rationale = f"{goal.label} (mark {goal.mark}) fits best with {goal.score:.2f}: {because}"
        rationale += f". Nothing has to go first. {spot.because}{_remarks(query, grounding)}"
        return Plan(
            target=goal.label,
            rationale=rationale,
            role="goal",
            kind=spot.kind,
            mark=goal.mark,
            grid=self.grid,
            cell=spot.choice.cell,
            objects=self._objects(scene, grounding),
            degraded=spot.degraded,
        )

    def _clear(self, scene: Scene, query: Query, grounding: Grounding, goal: Match, way: Way, memory: Memory) -> Plan:
        thing = scene.proposal(way.first)
        spot = _spot(scene, thing, self.grid, None, None, memory)
        names = _names(scene, grounding, self.min_score)
        steps = "; ".join(_why(e, names) for e in way.edges)
        rationale = f"the goal is {goal.label} (mark {goal.mark}, fits {goal.score:.2f}), but {steps}"
        rationale += (
            f"; so {names[way.first]} (mark {way.first}) goes first. {spot.because}{_remarks(query, grounding)}"
        )
        return Plan(
            target=names[way.first],
            rationale=rationale,
            role="obstruction",
            kind=spot.kind,
            mark=way.first,
            grid=self.grid,
            cell=spot.choice.cell,
            objects=self._objects(scene, grounding),
            degraded=spot.degraded,
        )

    def _search(
        self,
        scene: Scene,
        query: Query,
        grounding: Grounding,
        fitting: Sequence[Match],
        memory: Memory,
        worn_out: set[int],
    ) -> Plan:
        names = _names(scene, grounding, self.min_score)
        if fitting:
            missing = f"{fitting[0].label} (mark {fitting[0].mark}) is left for later, as taking it failed"
        else:
            best = grounding.matches[0]
            closest = f"(closest: {names[best.mark]} with {best.score:.2f})"
            missing = f"nothing in view answers to {query.label!r} {closest}"
        hider = self._hider(scene, query, fitting, memory, worn_out)
        if hider is None and fitting:
            return self._take_goal(scene, query, grounding, fitting[0], memory)
        if hider is None:
            reason = f"{missing}, and nothing that could hide it; in view: {self._in_view(scene)}"
            remarks = _remarks(query, grounding)
            plan = self._nothing(query, f"{reason}.{remarks}" if remarks else reason)
            return replace(plan, objects=self._objects(scene, grounding))
        spot = _spot(scene, scene.proposal(hider.mark), self.grid, None, None, memory)
        what = "most likely hides it" if hider.suspected else "goes first"
        rationale = f"{missing}; {names[hider.mark]} (mark {hider.mark}) {what}, because {hider.reason}"
        return Plan(
            target=names[hider.mark],
            rationale=f"{rationale}. {spot.because}{_remarks(query, grounding)}",
            role="obstruction",
            kind=spot.kind,
            mark=hider.mark,
            grid=self.grid,
            cell=spot.choice.cell,
            objects=self._objects(scene, grounding),
            degraded=spot.degraded,
        )

    def _hider(
        self, scene: Scene, query: Query, fitting: Sequence[Match], memory: Memory, worn_out: set[int]
    ) -> Hider | None:
        """Return what to clear; None where the goal is to be tried again, or nothing can be cleared."""
        goals = {m.mark for m in fitting}
        skip = worn_out | goals
        size = _smallest_size(query)
        hider = None
        if size is not None:
            hider = likely_hider(scene, *size, in_piles_only=self.search == "piles", skip=skip)
        elif any(w.colors or w.shapes for w in query.wanted):
            hider = likely_hider(scene, 0.08, 0.03, in_piles_only=True, skip=skip)
        if hider is not None or self.search != "all":
            return hider
        stuck = {p.mark for p in scene.proposals if memory.has_no_grasp(p)}
        return next_to_clear(scene, skip) or (None if goals - stuck else next_to_clear(scene, stuck | goals))

    def _nothing(self, query: Query, rationale: str) -> Plan:
        return Plan(query.label, rationale, grid=self.grid, cell=middle_cell(self.grid), found=False)

    def _objects(self, scene: Scene, grounding: Grounding) -> tuple[PlannedObject, ...]:
        names = _names(scene, grounding, self.min_score)
        order = [m.mark for m in grounding.matches] or [p.mark for p in scene.proposals]
        planned: list[PlannedObject] = []
        for mark in order:
            thing = scene.proposal(mark)
            choice = choose_cell(Outline.of(scene, thing), thing, self.grid)
            score = 100 * choice.score * _gripper_fit(thing, self.max_width_m)
            planned.append(PlannedObject(names[mark], round(min(score, 100.0), 1), choice.cell))
        return tuple(planned)

    def _in_view(self, scene: Scene) -> str:
        names = list(_names(scene, Grounding(()), self.min_score).values())
        more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        return ", ".join(names[:MAX_LISTED]) + more


def _goal(matches: Sequence[Match], scene: Scene, worn_out: set[int]) -> Match | None:
    """Return the best match, or one nearly as good with nothing in its way."""
    if not matches:
        return None
    close = [m for m in matches if m.score >= CLOSE_SCORE * matches[0].score]
    return next((m for m in close if way_to(scene, m.mark, worn_out).first == m.mark), matches[0])


def _is_cut(thing: Proposal, scene: Scene) -> bool:
    """Whether a thing reaches out of the image or of the workspace."""
    workspace = scene.frame.workspace
    if thing.touches_border or workspace is None:
        return thing.touches_border
    around = ndimage.binary_dilation(thing.mask, iterations=2).astype(bool)
    outside = around & ~workspace & (scene.frame.depth > 0)
    return int(outside.sum()) > 0.05 * int(around.sum())


@dataclass(frozen=True)
class _Spot:
    """Where to take one thing."""

    choice: CellChoice
    kind: PlanKind
    because: str
    degraded: tuple[Degradation, ...]


def _spot(scene: Scene, thing: Proposal, grid: int, part: str | None, name: str | None, memory: Memory) -> _Spot:
    outline = Outline.of(scene, thing)
    known = load_knowledge().objects.get(name) if name else None
    degraded: tuple[Degradation, ...] = ()
    taken: Part | None = None
    region: Mask | None = None
    if part is not None:
        taken, region = _asked_part(outline, part, known)
        if region is None:
            reason = f"the outline does not show where the {part} is"
            degraded = (Degradation("plan", reason, "the whole object, its best cell"),)
    if region is None and known is not None:
        for preferred in known.take:
            region = part_region(outline, preferred.place)
            if region is not None:
                taken = preferred
                break
    avoid = None
    if known is not None and not (part is not None and any(p.name == part for p in known.avoid)):
        regions = [r for p in known.avoid if (r := part_region(outline, p.place)) is not None]
        avoid = regions[0] if regions else None
    failed = [a.cell for a in memory.failures_at(thing)]
    choice = choose_cell(outline, thing, grid, take=region, avoid=avoid, failed=failed)
    words = [f"Cell {choice.cell} of {grid}x{grid}: {', '.join(choice.reasons)}"]
    if region is not None and taken is not None:
        words.append(f"to take it by the {taken.name}")
    if avoid is not None and known is not None:
        words.append(f"away from the {known.avoid[0].name}")
    if failed:
        words.append(f"{len(failed)} earlier tries failed, in cells {sorted(set(failed))}")
    return _Spot(choice, "part" if region is not None else "object", ", ".join(words) + ".", degraded)


def _asked_part(outline: Outline, word: str, known: KnownObject | None) -> tuple[Part, Mask | None]:
    part = known.part(word) if known is not None else None
    part = part or Part(word, load_vocabulary().parts[word])
    region = part_region(outline, part.place)
    if region is None and part.place in ("top", "bottom"):
        region = part_region(outline, "thin" if part.place == "top" else "wide")
    if region is None and part.place == "protrusion":
        region = part_region(outline, "thin")
    return part, region


def _wanted_part(query: Query, goal: Match) -> str | None:
    for wanted in query.wanted:
        if wanted.part is not None and (not wanted.has_noun or goal.name in candidates(wanted)):
            return wanted.part
    return None


def _gripper_fit(thing: Proposal, max_width_m: float) -> float:
    """Return 1 where the thing goes between the fingers or has a rim, less the more its thinnest side exceeds them."""
    if thing.shape_degree("hollow") >= 0.5:
        return 1.0
    over = thing.extents_m[2] / max_width_m
    return 1.0 if over <= 0.9 else max(0.1, 1 - 2 * (over - 0.9))


def _failures_last(matches: Sequence[Match], scene: Scene, memory: Memory) -> list[Match]:
    """Return the matches by score, each less by FAILURE_PENALTY per failed attempt at it."""
    less = [
        replace(m, score=m.score * FAILURE_PENALTY ** len(memory.failures_at(scene.proposal(m.mark)))) for m in matches
    ]
    return sorted(less, key=lambda m: (-m.score, m.mark))


def _names(scene: Scene, grounding: Grounding, min_score: float) -> dict[int, str]:
    """Return a readable name per mark: as asked for, else a plain one."""
    named = grounding.matches if grounding.names_are_known else grounding.fitting(min_score)
    asked = {m.mark: m.label for m in named}
    return plain_names(scene) | asked


def _why(edge: Obstruction, names: dict[int, str]) -> str:
    a, b = names[edge.a], names[edge.b]
    if edge.relation == "hides":
        return f"{a} hides {b} ({edge.evidence:.0f} px)"
    if edge.relation == "rests_on":
        return f"{a} rests on {b}"
    return f"{a} blocks the way to {b} ({edge.evidence * 100:.1f} cm free)"


def _smallest_size(query: Query) -> tuple[float, float] | None:
    """Return longest and shortest side that the wanted thing has at least, in the middle of all that answer [m]."""
    k = knowledge_arrays()
    rows = sorted({k.names.index(name) for w in query.wanted for name in _nouns(w)})
    if not rows:
        return None
    longest, shortest = sorted(k.longest_m[rows, 0]), sorted(k.shortest_m[rows, 0])
    return float(longest[len(rows) // 2]), float(shortest[len(rows) // 2])


def _nouns(wanted: Wanted) -> tuple[str, ...]:
    if wanted.names:
        return wanted.names
    return tuple(candidates(wanted)) if wanted.has_noun else ()


def _remarks(query: Query, grounding: Grounding) -> str:
    remarks = [f" Not understood: {_quoted(query.unknown)}."] if query.unknown else []
    remarks += [f" {note[0].upper()}{note[1:]}." for note in grounding.notes]
    return "".join(remarks)


def _quoted(words: tuple[str, ...]) -> str:
    shown = ", ".join(repr(w[:40]) for w in words[:MAX_LISTED])
    return shown + (f" and {len(words) - MAX_LISTED} more" if len(words) > MAX_LISTED else "")
