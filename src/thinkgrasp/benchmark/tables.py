"""The tables of a report, from the numbers of `metrics`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from thinkgrasp.benchmark import published
from thinkgrasp.benchmark.document import Table
from thinkgrasp.benchmark.failures import STAGES, Stage
from thinkgrasp.benchmark.metrics import Cost, Mean, Pairing, Rate, Summary, Time, exact_share
from thinkgrasp.benchmark.results import Results
from thinkgrasp.benchmark.statistics import Interval
from thinkgrasp.loop import END_WORDS

NONE = "-"
"""Where there is nothing to say."""
END_NOTES: dict[str, str] = {
    **END_WORDS,
    "no_scene": "no pile came out as asked for",
    "crashed": "the episode crashed",
}


def main_table(results: Results, summaries: Sequence[Summary], pairs: Mapping[str, Pairing]) -> Table:
    """Return the paper's metrics, one row per method."""
    rows = [
        (
            s.method,
            f"{s.n_success.k}/{s.n_success.n}",
            number(s.success.value, 3),
            bounds(s.n_success.interval, 3),
            number(s.steps.value, 2),
            mean_text(s.steps_at_limit),
            mean_text(s.success_steps),
            p_value(pairs[s.method].success_p_holm) if s.method in pairs else "reference",
        )
        for s in summaries
    ]
    return Table(
        f"Success and grasps, {results.suite}",
        ("method", "solved", "average success", "95 %", "average steps", f"steps, failures as {results.step_limit}",
         "average success steps", "p against reference"),
        tuple(rows),
        "Averages over the runs of a task, then over the tasks. Success: Wilson's interval of all episodes; steps: "
        "stratified bootstrap. Average steps count the grasps that a failure used, so that giving up early looks "
        f"cheap; the next column counts every failure as {results.step_limit}. p: exact McNemar test on the same "
        "piles, adjusted for the number of methods (Holm).",
    )  # fmt: skip


def pairing_table(pairs: Sequence[Pairing]) -> Table:
    """Return the paired tests, one row per method."""
    rows = [
        (
            p.method,
            str(p.pairs),
            f"{p.both} / {p.only_method} / {p.only_reference} / {p.neither}",
            f"{p.success_difference:+.3f} ({bounds(p.success_interval, 3, signed=True)})",
            f"{p_value(p.success_p)} ({p_value(p.success_p_holm)})",
            mean_text(p.steps_difference, signed=True),
            f"{p_value(p.steps_p)} ({p_value(p.steps_p_holm)})",
        )
        for p in pairs
    ]
    return Table(
        f"Against {pairs[0].reference}, pile by pile",
        ("method", "pairs", "both / only it / only reference / neither", "success difference (95 %)", "p (Holm)",
         "steps difference (95 %)", "p (Holm)"),
        tuple(rows),
        "Only piles on which both finished. Success: exact McNemar test, Newcombe's paired interval. Steps count a "
        "failure as all attempts: exact test of the differences' signs (Pitman), bootstrap interval. p in brackets is "
        "adjusted for the number of methods (Holm).",
    )  # fmt: skip


def efficiency_table(results: Results, summaries: Sequence[Summary]) -> Table:
    """Return grasps against the fewest possible."""
    share = exact_share(results)
    rows = [
        (
            s.method,
            f"{s.efficiency.episodes} of {s.efficiency.successes}",
            mean_text(s.efficiency.ratio),
            mean_text(s.efficiency.extra),
        )
        for s in summaries
    ]
    return Table(
        "Grasps over the fewest possible",
        ("method", "solved episodes counted", "grasps / fewest", "grasps more than fewest"),
        tuple(rows),
        f"Fewest: searched in the simulator. Only successes on piles where the search was complete: {share.k} of "
        f"{share.n} piles ({percent(share.value)}); the other {share.n - share.k} are left out. A method that solves "
        "only what is easy looks good here: read it beside its success.",
    )


def ends_table(summaries: Sequence[Summary]) -> Table:
    """Return how episodes ended, by reason."""
    ends = [end for end in END_NOTES if any(s.ends.get(end) for s in summaries)]
    ends += sorted({end for s in summaries for end in s.ends} - set(ends))
    rows = [(s.method, *(str(s.ends.get(end, 0)) for end in ends)) for s in summaries]
    note = "; ".join(f"{end}: {END_NOTES[end]}" for end in ends if end in END_NOTES)
    return Table("How episodes ended", ("method", *ends), tuple(rows), f"{note}.")


def reasoning_table(summaries: Sequence[Summary]) -> Table:
    """Return how often the right thing was chosen, against chance."""
    rows = [
        (
            s.method,
            str(s.reasoning.right.n),
            _rate(s.reasoning.right),
            percent(s.reasoning.chance),
            bounds(s.reasoning.over_chance, 1, scale=100, signed=True),
        )
        for s in summaries
    ]
    return Table(
        "Obstruction reasoning",
        ("method", "choices", "right (95 %)", "blind pick", "points over blind pick, 95 %"),
        tuple(rows),
        "Right: the goal where it could be taken, else something that truly obstructs it. Blind pick: how often any "
        "object in view would have been right, at the same steps. Steps of an episode belong together: intervals "
        "resample episodes.",
    )


def grasps_table(summaries: Sequence[Summary]) -> Table:
    """Return how grasps went, and what else was moved."""
    rows = [
        (
            s.method,
            f"{s.grasps.k}/{s.grasps.n}",
            _rate(s.grasps),
            f"{s.goal_grasps.k}/{s.goal_grasps.n}",
            _rate(s.goal_grasps),
            f"{s.wrong_deliveries.k}/{s.wrong_deliveries.n}",
            _rate(s.wrong_deliveries),
            number(s.toppled.value, 2),
            number(s.pushed_out.value, 2),
        )
        for s in summaries
    ]
    return Table(
        "Grasps, wrong objects, damage",
        ("method", "held", "grasp success (95 %)", "held, at a goal", "goal grasp success (95 %)", "wrong / delivered",
         "wrong-object rate (95 %)", "toppled per episode", "pushed out per episode"),
        tuple(rows),
        "Held: from closing until it was let go over the bin, of all executed grasps. Wrong: another object delivered "
        "as the goal, of all deliveries meant as the goal. Intervals resample episodes.",
    )  # fmt: skip


def time_table(summaries: Sequence[Summary]) -> Table:
    """Return milliseconds by stage."""
    stages = [stage for stage in dict.fromkeys(stage for s in summaries for stage in s.times) if stage != "rest"]
    stages += ["rest"] if any("rest" in s.times for s in summaries) else []
    rows = [(s.method, *(_time(s.times.get(stage)) for stage in stages)) for s in summaries]
    return Table(
        "Time of a step [ms], median / 90th percentile",
        ("method", *stages),
        tuple(rows),
        "Wall time while the workers shared the machine; rest: execution in the simulator, the next frame, and "
        "decisions that were put aside.",
    )


def cost_table(summaries: Sequence[Summary]) -> Table:
    """Return tokens and dollars."""
    rows = [(s.method, *_cost(s.cost)) for s in summaries]
    return Table(
        "What the model cost",
        (
            "method",
            "requests per episode",
            "tokens in + out per episode",
            "per grasp",
            "dollars per episode",
            "per grasp",
        ),
        tuple(rows),
        "An emulated model's tokens are made up after one model's published rules.",
    )


def degraded_table(summaries: Sequence[Summary]) -> Table | None:
    """Return what fell back, and how often; None where nothing did."""
    kinds = sorted({kind for s in summaries for kind in s.degraded})
    if not kinds:
        return None
    rows = [(s.method, *(str(s.degraded.get(kind, 0)) for kind in kinds), str(s.n_decisions)) for s in summaries]
    return Table("Fallbacks taken", ("method", *kinds, "of decisions"), tuple(rows))


def failure_table(summaries: Sequence[Summary]) -> Table:
    """Return which stage cost how many episodes."""
    counts = {s.method: Counter(f.stage for f in s.failures) for s in summaries}
    stages: list[Stage] = [stage for stage in STAGES if any(own[stage] for own in counts.values())]
    rows = [
        (s.method, str(len(s.failures)), *(_share(counts[s.method][stage], s.finished) for stage in stages))
        for s in summaries
    ]
    note = "; ".join(f"{stage}: {STAGES[stage]}" for stage in stages)
    return Table(
        "What failed episodes failed of",
        ("method", "failures", *stages),
        tuple(rows),
        f"By the simulator's truth, in percent of all episodes. {note}.",
    )


def task_success_table(results: Results, summaries: Sequence[Summary]) -> Table:
    """Return success by task."""
    found = {s.method: {t.task: t.success for t in s.tasks} for s in summaries}
    rows: list[tuple[str, ...]] = []
    shades: list[tuple[float | None, ...]] = []
    for task in _tasks(results, summaries):
        rates = [found[s.method].get(task) for s in summaries]
        rows.append((task, *(NONE if rate is None else f"{rate.k}/{rate.n}" for rate in rates)))
        shades.append((None, *(None if rate is None else rate.value for rate in rates)))
    return Table("Solved by task", ("task", *(s.method for s in summaries)), tuple(rows), shades=tuple(shades))


def task_steps_table(results: Results, summaries: Sequence[Summary]) -> Table:
    """Return grasps by task."""
    found = {s.method: {t.task: t for t in s.tasks} for s in summaries}
    rows = [
        (
            task,
            *(
                NONE
                if (t := found[s.method].get(task)) is None
                else f"{number(t.steps, 1)} / {number(t.success_steps, 1)}"
                for s in summaries
            ),
        )
        for task in _tasks(results, summaries)
    ]
    return Table("Average steps / average success steps by task", ("task", *(s.method for s in summaries)), tuple(rows))


def published_table(results: Results, summaries: Sequence[Summary]) -> Table:
    """Return the paper's averages above ours."""
    group = results.plan.source.group
    rows = [
        (
            f"{p.method} (paper)",
            f"{p.success(group):.3f}",
            bounds(p.interval(group), 3),
            _as_given(p.steps(group)),
            NONE,
        )
        for p in published.TABLE
    ]
    rows += [
        (
            s.method,
            number(s.success.value, 3),
            bounds(s.n_success.interval, 3),
            number(s.steps.value, 2),
            number(s.success_steps.value, 2),
        )
        for s in summaries
    ]
    return Table(
        f"The paper's {'clutter' if group == 'clutter' else 'heavy clutter'} averages, and ours",
        ("method", "average success", "95 %", "average steps", "average success steps"),
        tuple(rows),
        f"{published.SOURCE} The intervals of its rates are ours: Wilson's, where the rate is a whole number of "
        f"episodes at {published.RUNS} runs a task.",
    )


def number(value: float | None, digits: int, *, signed: bool = False) -> str:
    """Return a number, or a dash."""
    return NONE if value is None else f"{value:{'+' if signed else ''}.{digits}f}"


def percent(value: float | None) -> str:
    """Return "97.3 %", or a dash."""
    return NONE if value is None else f"{100 * value:.1f} %"


def bounds(interval: Interval | None, digits: int, *, scale: float = 1, signed: bool = False) -> str:
    """Return "0.94 to 0.99", or a dash."""
    if interval is None:
        return NONE
    return " to ".join(number(scale * at, digits, signed=signed) for at in interval)


def mean_text(mean: Mean, *, signed: bool = False) -> str:
    """Return "2.31 (2.02 to 2.70)"."""
    shown = number(mean.value, 2, signed=signed)
    return shown if mean.interval is None else f"{shown} ({bounds(mean.interval, 2, signed=signed)})"


def p_value(p: float) -> str:
    """Return "0.031" or "< 0.001"."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _as_given(value: float | None) -> str:
    return NONE if value is None else f"{value:g}"


def _rate(rate: Rate) -> str:
    if rate.interval is None:
        return percent(rate.value)
    return f"{percent(rate.value)} ({bounds(rate.interval, 1, scale=100)})"


def _time(time: Time | None) -> str:
    return NONE if time is None else f"{time.median:.0f} / {time.p90:.0f}"


def _cost(cost: Cost) -> tuple[str, ...]:
    if not cost.requests:
        return ("none asked", *(NONE,) * 4)
    episodes, steps = max(cost.episodes, 1), max(cost.steps, 1)

    def tokens(by: int) -> str:
        return f"{cost.prompt_tokens / by:.0f} + {cost.completion_tokens / by:.0f}"

    def dollars(by: int) -> str:
        return "not known" if cost.usd is None else f"{cost.usd / by:.4f}"

    requests = f"{cost.requests / episodes:.1f}"
    return requests, tokens(episodes), tokens(steps), dollars(episodes), dollars(steps)


def _share(k: int, n: int) -> str:
    return f"{k} ({100 * k / n:.1f} %)" if n else NONE


def _tasks(results: Results, summaries: Sequence[Summary]) -> list[str]:
    return list(dict.fromkeys((*results.plan.tasks, *(t.task for s in summaries for t in s.tasks))))
