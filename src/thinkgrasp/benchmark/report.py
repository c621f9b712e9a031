"""What a benchmark found: report.md with its plots, report.html and rows.tex beside the results."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from thinkgrasp.benchmark import plots, published, tables
from thinkgrasp.benchmark.document import FIGURES, Block, Figure, Items, Section, Text, markdown, table_lines
from thinkgrasp.benchmark.failures import STAGES
from thinkgrasp.benchmark.metrics import Pairing, Summary, pairings, summarize, unsolved
from thinkgrasp.benchmark.plan import Session, different_sources
from thinkgrasp.benchmark.records import CRASHED, NO_SCENE
from thinkgrasp.benchmark.report_page import page
from thinkgrasp.benchmark.results import Results, load_results
from thinkgrasp.errors import ConfigError
from thinkgrasp.outputs import make_folder, write_atomic
from thinkgrasp.sim.tasks import TASKS

TITLE = "ThinkGrasp benchmark"
MARKDOWN, HTML, LATEX = "report.md", "report.html", "rows.tex"


def write_report(folders: Sequence[Path], reference: str | None = None) -> str:
    """Write the report of one or several result folders into the first of them.

    Args:
        folders: Of the same suite with other methods or runs, or of other suites.
        reference: The method that the others are tested against; by default the first of each suite.

    Returns:
        The main table of each suite, and where the report lies.

    Raises:
        InputError: A folder is none of a benchmark, holds nothing yet, or does not fit to another.
        ConfigError: No suite has the reference method.
    """
    found = load_results(folders)
    _check_reference(found, reference)
    sections: list[Section] = []
    shown: list[str] = []
    rows: list[str] = []
    for results in found:
        summaries = [summarize(results, method) for method in results.methods]
        chosen = reference if reference in results.methods else results.methods[0]
        pairs = pairings(results, chosen)
        own = _sections(results, summaries, pairs, reference)
        sections += own
        shown += ["\n".join(table_lines(tables.main_table(results, summaries, {p.method: p for p in pairs}))), ""]
        shown += [
            f"{results.suite}: {_progress(results)}",
            *(f"warning: {w}" for w in _warnings(results, summaries)),
            "",
        ]
        rows += _latex(results, summaries)
    first = folders[0]
    make_folder(first / FIGURES)
    for block in (block for section in sections for block in section.blocks):
        if isinstance(block, Figure):
            write_atomic(first / FIGURES / f"{block.name}.svg", plots.standalone(block.svg).encode())
    write_atomic(first / MARKDOWN, markdown(TITLE, sections).encode())
    write_atomic(first / HTML, page(TITLE, sections).encode())
    write_atomic(first / LATEX, ("\n".join(rows) + "\n").encode())
    return "\n".join([*shown, f"report: {first / MARKDOWN}, {first / HTML}, {first / LATEX}"])


def _check_reference(found: Sequence[Results], reference: str | None) -> None:
    known = list(dict.fromkeys(method for results in found for method in results.methods))
    if reference is not None and reference not in known:
        raise ConfigError(f"no results of method {reference!r} to compare with; there are {', '.join(known)}")


def _sections(
    results: Results, summaries: Sequence[Summary], pairs: Sequence[Pairing], reference: str | None
) -> list[Section]:
    by_method = {p.method: p for p in pairs}
    head: list[Block] = [Text(_progress(results))]
    head += [Text(words, "warning") for words in _warnings(results, summaries)]
    if reference is not None and reference not in results.methods:
        head.append(
            Text(f"{results.suite} has no results of {reference}; its reference is {results.methods[0]}.", "note")
        )
    head.append(tables.main_table(results, summaries, by_method))
    head.append(
        Figure(
            "Success with 95 % intervals",
            f"{results.suite}-success",
            plots.rates(_bars(summaries), f"Success, {results.suite}"),
        )
    )
    if pairs:
        head.append(tables.pairing_table(pairs))
    steps: list[Block] = [
        tables.efficiency_table(results, summaries),
        Figure("Grasps per episode", f"{results.suite}-grasps", _histograms(results, summaries)),
        Figure(
            "Share of episodes not yet solved", f"{results.suite}-unsolved",
            plots.survival(
                {s.method: unsolved(results, s.method) for s in summaries},
                f"Episodes not yet solved, {results.suite}", "executed grasps", "not yet solved",
            ),
            "An episode that ended early without its goal is never solved: its end competes with success. Counted as "
            "censored (Kaplan and Meier), a method that gives up would be credited with what others still achieve.",
        ),
        tables.ends_table(summaries),
    ]  # fmt: skip
    choices: list[Block] = [tables.reasoning_table(summaries), tables.grasps_table(summaries)]
    costs: list[Block] = [tables.time_table(summaries), tables.cost_table(summaries)]
    if degraded := tables.degraded_table(summaries):
        costs.append(degraded)
    curves = _accuracy_curves(summaries)
    if curves:
        title = "Success over how often the emulated model is right"
        plot = plots.curves(curves, title, "right replies of the emulated model", "success")
        head.append(Figure(title, f"{results.suite}-accuracy", plot))
    return [
        Section(results.suite, tuple(head)),
        Section(f"{results.suite}: by task", (tables.task_success_table(results, summaries),
                                              tables.task_steps_table(results, summaries)), 3),
        Section(f"{results.suite}: grasps and ends", tuple(steps), 3),
        Section(f"{results.suite}: choices and grasps", tuple(choices), 3),
        Section(f"{results.suite}: failures", _failures(results, summaries), 3),
        Section(f"{results.suite}: time and cost", tuple(costs), 3),
        Section(f"{results.suite}: the paper's figures",
                (tables.published_table(results, summaries), Items("What may be compared", published.COMPARABLE)), 3),
        Section(f"{results.suite}: to run it again", _reproduce(results), 3),
    ]  # fmt: skip


def _progress(results: Results) -> str:
    done = len(results.planned & results.records.episodes.keys())
    text = f"{done} of {len(results.planned)} planned episodes are finished"
    if done == len(results.planned):
        return f"{text}."
    counts = Counter(key.method for key in results.planned)
    left = Counter(key.method for key in results.planned - results.records.episodes.keys())
    parts = [f"{method} {counts[method] - n} of {counts[method]}" for method, n in left.items() if n]
    return f"{text}; unfinished: {', '.join(sorted(parts))}."


def _warnings(results: Results, summaries: Sequence[Summary]) -> list[str]:
    found: list[str] = []
    sources = different_sources(results.plan.sessions)
    if len(sources) > 1:
        found.append(
            f"The results come from {len(sources)} states of the code ({', '.join(sources)}); they may not be "
            "of one system. Run it into a new folder for figures to keep."
        )
    for end, words in ((CRASHED, "crashed"), (NO_SCENE, "had no pile")):
        counts = {s.method: s.ends.get(end, 0) for s in summaries if s.ends.get(end)}
        if counts:
            told = ", ".join(f"{method} {n}" for method, n in counts.items())
            found.append(f"Episodes that {words} count as failures: {told}.")
    return found


def _bars(summaries: Sequence[Summary]) -> list[plots.Bar]:
    return [plots.Bar(s.method, s.n_success.k / s.n_success.n, s.n_success.interval) for s in summaries]


def _histograms(results: Results, summaries: Sequence[Summary]) -> str:
    counts: dict[str, list[tuple[int, int]]] = {}
    for s in summaries:
        episodes = [e for e in results.episodes(s.method).values() if e.end != NO_SCENE]
        good, bad = (Counter(e.steps for e in episodes if e.success is is_good) for is_good in (True, False))
        counts[s.method] = [(good[n], bad[n]) for n in range(results.step_limit + 1)]
    return plots.histograms(
        counts, f"Grasps per episode, {results.suite}", "executed grasps (hollow: the episode failed)"
    )


def _accuracy_curves(summaries: Sequence[Summary]) -> list[plots.Curve]:
    """Return success over accuracy of methods that differ by nothing else; at least two points each."""
    points: dict[str, list[tuple[float, plots.Bar]]] = {}
    for s, bar in zip(summaries, _bars(summaries), strict=True):
        name, at, rest = s.method.partition("@")
        accuracy, plus, truth = rest.partition("+")
        if at:
            points.setdefault(name + plus + truth, []).append((float(accuracy), bar))
    return [
        plots.Curve(name, tuple((x, bar.value, bar.interval) for x, bar in sorted(own, key=lambda point: point[0])))
        for name, own in points.items()
        if len(own) > 1
    ]


def _failures(results: Results, summaries: Sequence[Summary]) -> tuple[Block, ...]:
    failing = [s for s in summaries if s.failures]
    if not failing:
        return (Text("No episode failed."),)
    counts = {s.method: Counter(f.stage for f in s.failures) for s in failing}
    present = [stage for stage in STAGES if any(own[stage] for own in counts.values())]
    ordered = {method: {stage: own[stage] for stage in present} for method, own in counts.items()}
    title = f"Failed episodes by what cost them, {results.suite}"
    plot = plots.stacks(ordered, {s.method: s.finished for s in failing}, title)
    figure = Figure(title, f"{results.suite}-failures", plot)
    items = [
        Items(
            f"Failures of {s.method} ({len(s.failures)} of {s.finished})",
            tuple(
                f"{f.stage}: {f.key.task} seed {f.key.seed}, {f.end} after {f.steps}: {f.detail}"
                for f in sorted(s.failures, key=lambda f: list(STAGES).index(f.stage))
            ),
        )
        for s in failing
    ]
    return (tables.failure_table(summaries), figure, *items)


def _reproduce(results: Results) -> tuple[Block, ...]:
    plan = results.plan
    commands = [
        shlex.join(["thinkgrasp", "bench", "run", "--again", str(f), "--out", f"{f}-again"]) for f in results.folders
    ]
    seeds = sorted({key.seed for key in results.planned})
    return (
        Text("\n".join(commands), "code"),
        Text(
            "runs the same methods over the same piles: benchmark.json holds their whole configuration. "
            f"Seeds {seeds[0]} to {seeds[-1]}, {len(plan.tasks)} tasks, at most {results.step_limit} attempts; camera "
            f"{plan.camera.model} {plan.camera.size_wh[0]}x{plan.camera.size_wh[1]}, "
            f"{'with' if plan.camera.noise else 'without'} noise. Folders: {', '.join(map(str, results.folders))}."
        ),
        Items("Sessions", tuple(_session(session) for session in plan.sessions)),
    )


def _session(session: Session) -> str:
    versions = session.versions
    packages = ", ".join(f"{name} {version}" for name, version in versions.packages.items())
    return (
        f"{session.started:%Y-%m-%d %H:%M} UTC: thinkgrasp {versions.thinkgrasp} (code {versions.source}), Python "
        f"{versions.python}, {versions.machine}; {packages}"
    )


def _latex(results: Results, summaries: Sequence[Summary]) -> list[str]:
    """Return rows as in the paper's tables: of every task, then the average, three columns per method."""
    instructions = {scene.task: scene.instruction for scene in results.records.scenes.values()}
    instructions |= {task.name: task.instruction for task in TASKS if task.name not in instructions}
    lines = [
        f"% {results.suite}: {_progress(results)}",
        f"% columns: task; then success, steps, success steps of {', '.join(s.method for s in summaries)}",
    ]
    for task in results.plan.tasks:
        cells: list[str] = []
        for s in summaries:
            own = next((t for t in s.tasks if t.task == task), None)
            cells += (
                ["--"] * 3
                if own is None
                else [_cell(own.success.value, 3), _cell(own.steps, 2), _cell(own.success_steps, 2)]
            )
        lines.append(" & ".join([_escaped(instructions.get(task, task)), *cells]) + rf" \\ % {task}")
    cells = [
        _cell(mean.value, digits)
        for s in summaries
        for mean, digits in ((s.success, 3), (s.steps, 2), (s.success_steps, 2))
    ]
    lines += [r"\midrule", " & ".join(["Average", *cells]) + r" \\", ""]
    return lines


def _cell(value: float | None, digits: int) -> str:
    return "--" if value is None else f"{value:.{digits}f}"


def _escaped(words: str) -> str:
    return "".join(f"\\{c}" if c in "&%$#_{}" else c for c in words)
