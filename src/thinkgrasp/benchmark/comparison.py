"""Two result folders side by side: what was run otherwise, and which episodes came out otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from thinkgrasp.benchmark.document import Table, table_lines
from thinkgrasp.benchmark.metrics import pair
from thinkgrasp.benchmark.plan import BenchmarkPlan, different_sources
from thinkgrasp.benchmark.records import EpisodeRecord, SceneKey
from thinkgrasp.benchmark.results import Results, changed_records, load_results, only_in_one
from thinkgrasp.benchmark.statistics import wilson
from thinkgrasp.benchmark.tables import bounds, mean_text, p_value
from thinkgrasp.errors import InputError

SHOWN = 40
"""At most so many differences are told one by one."""


def compare(a: Path, b: Path) -> str:
    """Tell two result folders apart: plan, versions, results by shared method, and episodes that changed.

    Raises:
        InputError: A folder is none of a benchmark, or they are of different suites.
    """
    (first,), (second,) = load_results((a,)), load_results((b,))
    if first.suite != second.suite:
        raise InputError(f"{a} is of {first.suite} and {b} of {second.suite}: they have no pile in common")
    lines = [f"A: {a}", f"B: {b}", "", *_plans(first, second), ""]
    shared = [method for method in first.methods if method in second.methods]
    lines += _methods(first, second, shared) if shared else ["they share no method with finished episodes"]
    changed = [line for method in shared for line in _changes(first, second, method)]
    lines += ["", f"episodes whose result changed: {len(changed)}", *_some(changed)]
    missing = only_in_one(first.records, second.records)
    if missing:
        lines += ["", f"only in A or only in B: {len(missing)}", *_some(missing)]
    lines += ["", *_identity(first, second)]
    return "\n".join(lines)


def _identity(a: Results, b: Results) -> list[str]:
    """Say whether what both hold is the same, step by step."""
    n = len(a.records.episodes.keys() & b.records.episodes.keys())
    different = changed_records(a.records, b.records)
    if not different:
        return [f"same results: all {n} episodes that both hold are identical step by step, apart from times"]
    return [
        f"of {n} episodes and their piles that both hold, {len(different)} differ in more than times:",
        *_some(different),
    ]


def _plans(a: Results, b: Results) -> list[str]:
    found = [f"{name}: A {mine}, B {theirs}" for name, mine, theirs in _facts(a.plan, b.plan) if mine != theirs]
    mine, theirs = ({m.name: m for m in results.plan.methods} for results in (a, b))
    found += [f"method only in A: {name}" for name in mine if name not in theirs]
    found += [f"method only in B: {name}" for name in theirs if name not in mine]
    found += [
        f"method {name} is configured otherwise" for name in mine if name in theirs and mine[name] != theirs[name]
    ]
    return (
        ["what was run otherwise:", *(f"- {line}" for line in found)] if found else ["plan and versions are the same"]
    )


def _facts(a: BenchmarkPlan, b: BenchmarkPlan) -> list[tuple[str, str, str]]:
    def facts(plan: BenchmarkPlan) -> dict[str, str]:
        last = plan.sessions[-1].versions if plan.sessions else None
        found = {
            "layouts": str(plan.source.cases),
            "objects": str(plan.source.objects),
            "tasks": ", ".join(plan.tasks),
            "seeds": f"{plan.seeds.start} to {plan.seeds.stop - 1}",
            "camera": str(plan.camera),
            "code": ", ".join(different_sources(plan.sessions)) or "none",
        }
        if last is not None:
            found |= {"thinkgrasp": last.thinkgrasp, "Python": last.python, "machine": last.machine, **last.packages}
        return found

    mine, theirs = facts(a), facts(b)
    return [(name, mine.get(name, "none"), theirs.get(name, "none")) for name in dict.fromkeys((*mine, *theirs))]


def _methods(a: Results, b: Results, shared: Sequence[str]) -> list[str]:
    rows: list[tuple[str, ...]] = []
    for method in shared:
        mine, theirs = _keyed(a, method), _keyed(b, method)
        p = pair(method, method, theirs, mine, a.step_limit)
        steps = mean_text(p.steps_difference, signed=True)
        difference = f"{p.success_difference:+.3f} ({bounds(p.success_interval, 3, signed=True)})"
        rows.append(
            (method, _rate(mine), _rate(theirs), str(p.pairs), f"{p.only_reference} / {p.only_method}", difference,
             p_value(p.success_p), steps, p_value(p.steps_p))
        )  # fmt: skip
    columns = ("method", "A", "B", "pairs", "only A / only B", "B - A (95 %)", "p", "steps B - A (95 %)", "p")
    return table_lines(Table("", columns, tuple(rows)))


def _rate(episodes: dict[SceneKey, EpisodeRecord]) -> str:
    k, n = sum(e.success for e in episodes.values()), len(episodes)
    return f"{k}/{n} = {k / n:.3f} ({bounds(wilson(k, n), 3)})"


def _changes(a: Results, b: Results, method: str) -> list[str]:
    mine, theirs = _keyed(a, method), _keyed(b, method)
    return [
        f"{method} {key.task} seed {key.seed}: {mine[key].end} after {mine[key].steps}, now {theirs[key].end} after "
        f"{theirs[key].steps}"
        for key in mine
        if key in theirs and (mine[key].end, mine[key].steps) != (theirs[key].end, theirs[key].steps)
    ]


def _keyed(results: Results, method: str) -> dict[SceneKey, EpisodeRecord]:
    return {SceneKey(*key[1:]): episode for key, episode in results.episodes(method).items()}


def _some(lines: Sequence[str]) -> list[str]:
    shown = [f"- {line}" for line in lines[:SHOWN]]
    return [*shown, f"- and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else shown
