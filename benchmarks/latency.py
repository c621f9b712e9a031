"""Time of one decision stage by stage, peak memory, and import time.

    python benchmarks/latency.py [--frames DIR] [--repeats 15]

Without --frames the package's own rendered scene of ten things is used, at 640x480 and at 1280x720. DIR is a folder as
benchmarks/real_frames.py takes it; every instruction of it is decided, and medians are over all of them. Each row runs
in a fresh process, so that its peak memory is its own.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from real_frames import load_scene

from thinkgrasp import CameraIntrinsics, Frame, make_pipeline
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render

STAGES = ("scene", "plan", "segment", "generate", "check", "select", "total")
INSTRUCTIONS = ("the red box", "the white mug", "the soup can", "a fruit", "the drill", "the marker")


def rendered(width: int, height: int) -> Iterator[tuple[Frame, str]]:
    """Yield the package's own scene at a size, with instructions."""
    camera, T = demo_camera()
    scale = width / camera.width
    wide = CameraIntrinsics(width, height, camera.fx * scale, camera.fy * scale, (width - 1) / 2, (height - 1) / 2)
    frame = render(demo_scene(), wide, T).frame
    yield from ((frame, text) for text in INSTRUCTIONS)


def recorded(folder: Path, width: int) -> Iterator[tuple[Frame, str]]:
    """Yield the real frames of one width, with their instructions."""
    data = json.loads((folder / "annotations.json").read_text())
    scratch = Path(tempfile.mkdtemp())
    for name, scene in data["scenes"].items():
        frame = load_scene(folder, name, data["camera"], scratch)
        if frame.camera.width == width:
            yield from ((frame, entry["instruction"]) for entry in scene["instructions"])


def measure(folder: Path | None, width: int, height: int, repeats: int) -> tuple[list[float], float, int]:
    """Return the median of every stage [ms], the peak memory [MB] and the number of decisions."""
    cases = list(recorded(folder, width) if folder else rendered(width, height))
    pipeline = make_pipeline("offline")
    pipeline.decide(*cases[0])
    rows: list[list[float]] = []
    for _ in range(max(1, repeats // len(cases))):
        for frame, text in cases:
            times = dict(pipeline.decide(frame, text).timings_ms)
            rows.append([times.get(stage, 0.0) for stage in STAGES])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [float(v) for v in np.median(np.array(rows), axis=0)], peak, len(rows)


def import_time(runs: int = 7) -> float:
    """Return the median time of `import thinkgrasp` [ms], measured inside fresh processes."""
    code = "import time; t = time.perf_counter(); import thinkgrasp; print((time.perf_counter() - t) * 1e3)"
    return float(np.median([float(subprocess.check_output([sys.executable, "-c", code])) for _ in range(runs)]))


def main(
    frames: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    repeats: int = 15,
) -> None:
    """Print the table."""
    print(f"{'frame':10s} {'n':>4s} " + " ".join(f"{stage:>9s}" for stage in STAGES) + "   peak MB")
    context = multiprocessing.get_context("spawn")
    for width, height in ((640, 480), (1280, 720)):
        with context.Pool(1) as pool:
            medians, peak, n = pool.apply(measure, (frames, width, height, repeats))
        print(f"{width}x{height:<5d} {n:4d} " + " ".join(f"{m:6.0f} ms" for m in medians) + f"   {peak:7.0f}")
    print(f"import thinkgrasp: {import_time():.0f} ms")


if __name__ == "__main__":
    tyro.cli(main)
