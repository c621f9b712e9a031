"""The HTTP server under load: several clients for some minutes, latency, failures, and memory over time.

    python benchmarks/server_load.py                        # 4 clients, 5 minutes, one worker
    python benchmarks/server_load.py --workers 2 --minutes 1
    python benchmarks/server_load.py --url http://127.0.0.1:8000

Starts `thinkgrasp serve` with the offline preset in a process of its own (or asks the server at --url), and posts
rendered table tops at 640x480 with sentences about them, each client one after the other. A client that is told 429
waits as long as Retry-After says. Memory is read from /metrics. The exit code is 1 where an answer was neither 200 nor
429, or where memory grew.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import tyro

from thinkgrasp.server.background import server_process
from thinkgrasp.server.calls import frame_parts
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render

INSTRUCTIONS = ("the red box", "I need a fruit", "something to drink from", "the green bowl", "a bicycle", "the mug")
SCENES = 6
SETTLED_SHARE = 0.2
"""Memory is compared from here on: caches and allocators fill first."""
GROWTH_LIMIT = 0.05
"""Share by which the last fifth's median may exceed that of the fifth after settling."""


@dataclass
class Tally:
    """What all clients saw."""

    statuses: Counter[str] = field(default_factory=Counter[str])
    seconds: list[float] = field(default_factory=list[float])
    memory: list[tuple[float, float, float]] = field(default_factory=list[tuple[float, float, float]])
    """Time [s] since the start, and resident memory [MB] of the server and of all workers."""
    lock: threading.Lock = field(default_factory=threading.Lock)


def requests() -> list[dict[str, tuple[str, bytes, str]]]:
    """Return the multipart bodies that are sent in turn."""
    found: list[dict[str, tuple[str, bytes, str]]] = []
    for seed in range(SCENES):
        frame = render(demo_scene(seed), *demo_camera()).frame
        for words in INSTRUCTIONS:
            found.append({**frame_parts(frame, {}), "instruction": ("i.txt", words.encode(), "text/plain")})
    return found


def ask(url: str, bodies: list[dict[str, tuple[str, bytes, str]]], first: int, deadline: float, tally: Tally) -> None:
    """Be one client until the deadline."""
    with httpx.Client(timeout=120) as http:
        turn = first
        while time.perf_counter() < deadline:
            start = time.perf_counter()
            try:
                answer = http.post(f"{url}/v1/grasp", files=bodies[turn % len(bodies)])
                status, wait = str(answer.status_code), float(answer.headers.get("Retry-After", 0))
                if answer.status_code == 200:
                    json.loads(answer.content)
            except (httpx.HTTPError, ValueError) as error:
                status, wait = type(error).__name__, 0.1
            with tally.lock:
                tally.statuses[status] += 1
                if status == "200":
                    tally.seconds.append(time.perf_counter() - start)
            turn += 1
            time.sleep(wait)


def watch_memory(url: str, start: float, deadline: float, every_s: float, tally: Tally) -> None:
    """Read the server's memory until the deadline."""
    while time.perf_counter() < deadline:
        answer = httpx.get(f"{url}/metrics", timeout=30)
        answer.raise_for_status()
        text = answer.text
        own = sum(float(v) for v in re.findall(r"^thinkgrasp_resident_bytes (\S+)", text, re.M))
        workers = sum(float(v) for v in re.findall(r"^thinkgrasp_worker_resident_bytes\{\S+ (\S+)", text, re.M))
        tally.memory.append((time.perf_counter() - start, own / 1e6, workers / 1e6))
        time.sleep(every_s)


def growth(memory: list[tuple[float, float, float]]) -> float:
    """Return by which share memory at the end exceeds memory once it had settled; 0 where it does not.

    Infinite where memory was not seen: that it did not grow is not known then.
    """
    total = np.array([own + workers for _, own, workers in memory])
    if not total.any():
        return np.inf
    n = max(1, len(total) // 5)
    early, late = np.median(total[int(len(total) * SETTLED_SHARE) :][:n]), np.median(total[-n:])
    return max(0.0, float(late / early - 1))


def report(tally: Tally, minutes: float, clients: int) -> str:
    """Return the tables in Markdown."""
    p50, p95, p99 = np.percentile(tally.seconds, [50, 95, 99]) if tally.seconds else (np.nan,) * 3
    failures = sum(n for status, n in tally.statuses.items() if status not in ("200", "429"))
    lines = [
        f"{clients} clients, {minutes:g} min; load average at the end {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores",
        "",
        "| answers | 200 | 429 | other | per second | p50 | p95 | p99 |",
        "|" + 8 * "---|",
        f"| {sum(tally.statuses.values())} | {tally.statuses['200']} | {tally.statuses['429']} | {failures} "
        f"| {tally.statuses['200'] / (60 * minutes):.2f} | {p50:.2f} s | {p95:.2f} s | {p99:.2f} s |",
        "",
        "| time | server | workers |",
        "|---|---|---|",
    ]
    picked = np.unique(np.linspace(0, len(tally.memory) - 1, min(12, len(tally.memory))).astype(int))
    lines += [
        f"| {seconds:.0f} s | {own:.0f} MB | {workers:.0f} MB |"
        for seconds, own, workers in (tally.memory[i] for i in picked)
    ]
    return "\n".join([*lines, "", f"growth after settling: {growth(tally.memory):.1%}"])


def main(
    clients: int = 4,
    minutes: float = 5,
    workers: int = 1,
    url: str | None = None,
    out: Path | None = None,
) -> None:
    """Print two tables in Markdown.

    Args:
        clients: So many at the same time.
        minutes: For so long.
        workers: Processes of the server that is started.
        url: Ask this server instead.
        out: Write all samples here as JSON.
    """
    bodies, tally = requests(), Tally()
    with server_process("--workers", str(workers)) if url is None else nullcontext(url) as address:
        start = time.perf_counter()
        deadline = start + 60 * minutes
        threads = [
            threading.Thread(target=ask, args=(address, bodies, i * len(bodies) // clients, deadline, tally))
            for i in range(clients)
        ]
        every_s = max(0.5, min(5, 60 * minutes / 60))
        threads.append(threading.Thread(target=watch_memory, args=(address, start, deadline, every_s, tally)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    print(report(tally, minutes, clients))
    if out is not None:
        out.write_text(json.dumps({"statuses": tally.statuses, "seconds": tally.seconds, "memory": tally.memory}))
    if set(tally.statuses) - {"200", "429"} or growth(tally.memory) > GROWTH_LIMIT:
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
