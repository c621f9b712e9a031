"""Whether a benchmark gives the same numbers however it runs, and how much faster two processes are than one.

    python benchmarks/bench_runner.py [--runs 3] [--repeats 1] [--kills 10] [--ray local] [--out DIR]

The same episodes (preset offline, oracle and an emulated model on three tasks) run through the real command: with one
worker; with two; with two, all processes killed (SIGKILL) at random moments and started again; and, with --ray, on a
Ray cluster. Every folder is compared with the first one, record by record, times apart. Episodes per hour
include the start of the processes and the report. Take the ratio from a machine with nothing else to do; with
--repeats, one and two workers take turns, so that a machine that is slower for a while counts for both.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tyro

from thinkgrasp.benchmark.records import RECORDS_FILE, read_records
from thinkgrasp.benchmark.results import same_results

TASKS = ("clutter-06-fruit", "clutter-07-drink", "clutter-09-pear")
METHODS = ("offline", "oracle", "vlm@0.8")


def command(out: Path, runs: int, *how: str) -> list[str]:
    """Return the command line that runs the episodes into a folder."""
    return [
        sys.executable, "-m", "thinkgrasp.cli", "bench", "run", "--suite", "clutter", "--tasks", *TASKS,
        "--preset", *METHODS, "--runs", str(runs), "--out", str(out), *how,
    ]  # fmt: skip


def run(out: Path, runs: int, *how: str) -> float:
    """Run to the end and return the time [s]."""
    start = time.perf_counter()
    subprocess.run(command(out, runs, *how), check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def run_killed(out: Path, runs: int, kills: int, seed: int) -> list[int]:
    """Run, kill and start again; return how many episodes were finished at each kill."""
    rng, finished = random.Random(seed), list[int]()
    for _ in range(kills):
        process = subprocess.Popen(
            command(out, runs, "--workers", "2"), stdout=subprocess.DEVNULL, start_new_session=True
        )
        before, wait = _size(out), rng.uniform(0.0, 8.0)
        while _size(out) <= before and process.poll() is None:
            time.sleep(0.05)
        time.sleep(wait)
        process.send_signal(signal.SIGKILL)  # the driver alone: its workers have to notice
        process.wait()
        finished.append(len(read_records(out).episodes))
    run(out, runs, "--workers", "2")
    return finished


def _size(out: Path) -> int:
    path = out / RECORDS_FILE
    return path.stat().st_size if path.exists() else 0


def verdict(reference: Path, other: Path) -> str:
    """Say whether two folders hold the same."""
    a, b = read_records(reference), read_records(other)
    different = same_results(a, b)
    lines = len((other / RECORDS_FILE).read_bytes().splitlines())
    expected = len(b.scenes) + len(b.episodes) + sum(len(steps) for steps in b.steps.values())
    kept = "no line lost or doubled" if lines == expected else f"{lines} lines instead of {expected}"
    same = f"{len(different)} differences, such as {different[0]}" if different else "the same numbers"
    return f"{len(b.episodes)} episodes, {same}, {kept}"


def main(
    runs: int = 3, repeats: int = 1, kills: int = 10, ray: str | None = None, seed: int = 0, out: Path | None = None
) -> None:
    """Run all ways and print the verdicts.

    Args:
        runs: Piles per task.
        repeats: Times that one and two workers run everything.
        kills: Times that the run is killed.
        ray: Address of a Ray cluster, or "local"; None = without.
        seed: Of the moments of the kills.
        out: Folder for the results; default: one that is removed.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = out or Path(scratch)
        one, killed, cluster = folder / "one-1", folder / "killed", folder / "ray"
        n = runs * len(TASKS) * len(METHODS)
        seconds: list[tuple[float, float]] = []
        for turn in range(1, repeats + 1):
            alone = run(folder / f"one-{turn}", runs, "--workers", "1")
            both = run(folder / f"two-{turn}", runs, "--workers", "2")
            print(f"one worker: {n / alone * 3600:.0f} episodes an hour")
            print(f"two workers: {n / both * 3600:.0f} episodes an hour, {alone / both:.2f} times as many")
            print(f"  {verdict(one, folder / f'two-{turn}')}", flush=True)
            seconds.append((alone, both))
        if repeats > 1:
            alone, both = (sum(column) for column in zip(*seconds, strict=True))
            print(f"all turns: {repeats * n / alone * 3600:.0f} and {repeats * n / both * 3600:.0f} episodes an hour, "
                  f"{alone / both:.2f} times as many")  # fmt: skip
        if kills:
            finished = run_killed(killed, runs, kills, seed)
            print(f"killed {kills} times, with {', '.join(map(str, finished))} of {n} episodes finished")
            print(f"  {verdict(one, killed)}", flush=True)
        if ray is not None:
            print(f"Ray, {ray}: {n / run(cluster, runs, '--ray', ray) * 3600:.0f} episodes an hour")
            print(f"  {verdict(one, cluster)}")


if __name__ == "__main__":
    tyro.cli(main)
