"""Recorded episodes as a report in Markdown; again, from a file:

python benchmarks/episode_report.py episodes.jsonl
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from episode_records import EpisodeRecord, RecordLog, Tried, counted, why_failed
from trials import rate

TARGETS = {
    ("clutter", "oracle"): 0.98,
    ("clutter", "offline"): 0.85,
    ("heavy", "oracle"): 0.95,
    ("heavy", "offline"): 0.60,
}
"""Least share of successes that is aimed for, by suite and preset."""


def report(records: Sequence[EpisodeRecord]) -> str:
    """Return a section per suite and preset."""
    groups: dict[tuple[str, str], list[EpisodeRecord]] = defaultdict(list)
    for record in records:
        groups[record.suite, record.preset].append(record)
    return "\n\n".join("\n".join(_section(*key, group)) for key, group in groups.items())


def _section(suite: str, preset: str, records: list[EpisodeRecord]) -> list[str]:
    tried = [t for r in records for t in r.attempts]
    good = [r for r in records if r.success]
    losing = sum(bool(r.lost) for r in records)
    target = TARGETS.get((suite, preset))
    return [
        f"## {suite}, {preset}",
        "",
        f"- success: {rate(len(good), len(records))}{f'; target {100 * target:.0f} %' if target else ''}",
        f"- grasps per episode: mean {_mean_steps(records)}, over successes {_mean_steps(good)}",
        f"- ends: {counted(r.end for r in records)}",
        f"- grasps held up to the bin: {rate(sum(t.held for t in tried), len(tried))}",
        f"- outcomes: {counted(t.reason for t in tried)}",
        f"- another object delivered as the goal: {sum(t.is_wrong_delivery for t in tried)}",
        f"- objects that left the table untaken: {sum(len(r.lost) for r in records)}, in {losing} episodes",
        f"- decision: {_times([t.look.decision_ms for t in tried], 'ms', 0)}",
        f"- rest of an attempt: {_times([t.seconds for t in tried], 's', 2)}",
        f"- an episode: {_times([r.seconds for r in records], 's', 1)}",
        "",
        *_task_table(records),
        *_failures([r for r in records if not r.success]),
    ]


def _task_table(records: list[EpisodeRecord]) -> list[str]:
    lines = [
        "| task | success | grasps | over successes | held | objects | goal visible | ends |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for task in dict.fromkeys(r.task for r in records):
        of_task = [r for r in records if r.task == task]
        good = [r for r in of_task if r.success]
        tried: list[Tried] = [t for r in of_task for t in r.attempts]
        sizes = [r.n_objects for r in of_task if not r.error]
        shares = [max(r.visible) for r in of_task if r.visible]
        lines.append(
            f"| {task} | {len(good)}/{len(of_task)} | {_mean_steps(of_task)} | {_mean_steps(good)} "
            f"| {sum(t.held for t in tried)}/{len(tried)} | {_mean(sizes, 0)} | {_mean(shares, 2)} "
            f"| {counted(r.end for r in of_task)} |"
        )
    return lines


def _failures(failed: list[EpisodeRecord]) -> list[str]:
    if not failed:
        return []
    groups: dict[str, list[str]] = defaultdict(list)
    for r in failed:
        kind, particulars = why_failed(r)
        groups[kind].append(f"  - {r.task} seed {r.seed}, {r.end} after {r.steps}: {particulars}")
    lines = ["", f"Failures ({len(failed)}):", ""]
    for kind, each in sorted(groups.items(), key=lambda item: -len(item[1])):
        lines += [f"- {kind}: {len(each)}", *each]
    return lines


def _mean_steps(records: list[EpisodeRecord]) -> str:
    return _mean([r.steps for r in records if not r.error], 2)


def _mean(values: Sequence[float], digits: int) -> str:
    return f"{np.mean(values):.{digits}f}" if len(values) else "-"


def _times(values: Sequence[float], unit: str, digits: int) -> str:
    if not values:
        return "-"
    median, p90 = np.percentile(values, (50, 90))
    return f"mean {np.mean(values):.{digits}f}, median {median:.{digits}f}, 90th percentile {p90:.{digits}f} {unit}"


def main(file: tyro.conf.Positional[Path]) -> None:
    """Print the report of a file."""
    print(report(RecordLog(file, EpisodeRecord).records))


if __name__ == "__main__":
    tyro.cli(main)
