"""Time and memory of the learned segmenters at their published sizes, with random weights: nothing is downloaded.

    python benchmarks/segmenters.py [--models grounded_sam grounded_sam2 sam3] [--frames 4] [--threads 2] [--device cpu]

Each row runs in a process of its own, so that its peak memory is its own. A frame's first phrase encodes the image;
the second phrase about the same frame uses what is kept. Three masks are made per phrase. Time does not depend on
what weights say, apart from how many boxes pass, and that is fixed here. Beside the seconds that pass stand those
that the processor worked, over all threads: other work on the machine changes the former far more than the latter.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from thinkgrasp.testing import random_models
from thinkgrasp.types import CameraIntrinsics, Frame, Plan, Scene

Model = Literal["grounded_sam", "grounded_sam2", "sam3"]
MASKS_PER_PHRASE = 3


@dataclass(frozen=True)
class Row:
    """One line of the table: seconds (passed, worked), and MiB."""

    parameters: int
    load_s: float
    first_s: tuple[float, float]
    second_s: tuple[float, float]
    peak_mib: float
    gpu_mib: float | None


@dataclass(frozen=True)
class Contender:
    """What a row is called, what it is saved with, and how its segmenter is made from the folder."""

    title: str
    save: tuple[Callable[..., Path], ...]
    make: Callable[[list[Path], dict[str, Any]], Any]


def _pair(folders: list[Path], settings: dict[str, Any]) -> Any:
    from thinkgrasp.segmenters.grounded_sam import GroundedSamSegmenter

    return GroundedSamSegmenter(
        detector=folders[0], masks=folders[1], box_threshold=0.0, text_threshold=0.0, **settings
    )


def _sam3(folders: list[Path], settings: dict[str, Any]) -> Any:
    from thinkgrasp.segmenters.sam3 import Sam3Segmenter

    return Sam3Segmenter(model=folders[0], score_threshold=0.0, **settings)


CONTENDERS: dict[Model, Contender] = {
    "grounded_sam": Contender(
        "GroundingDINO-T + SAM-B", (random_models.save_grounding_dino, random_models.save_sam), _pair
    ),
    "grounded_sam2": Contender(
        "GroundingDINO-T + SAM 2 small", (random_models.save_grounding_dino, random_models.save_sam2), _pair
    ),
    "sam3": Contender("SAM 3", (random_models.save_sam3,), _sam3),
}


def scene(width: int, height: int, seed: int) -> Scene:
    """Return a frame of noise."""
    color = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    camera = CameraIntrinsics(width, height, 600.0, 600.0, (width - 1) / 2, (height - 1) / 2)
    depth = np.ones((height, width), np.float32)
    return Scene(Frame(color, depth, camera), np.ones((height, width, 3), np.float32))


def save(name: Model, folder: Path) -> None:
    """Save what a row needs, in a process whose memory does not count."""
    for number, one in enumerate(CONTENDERS[name].save):
        (folder / str(number)).mkdir()
        one(folder / str(number), small=False)


def measure(
    name: Model, folder: Path, size_wh: tuple[int, int], frames: int, threads: int | None, settings: dict[str, Any]
) -> Row:
    """Load, look at several frames with two phrases each, and return medians, without the first of several frames."""
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
    start = time.perf_counter()
    segmenter = CONTENDERS[name].make(sorted(folder.iterdir()), {"max_segments": MASKS_PER_PHRASE, **settings})
    load_s = time.perf_counter() - start
    firsts: list[tuple[float, float]] = []
    seconds: list[tuple[float, float]] = []
    for seed in range(frames):
        view = scene(*size_wh, seed)
        for times, phrase in ((firsts, "red mug"), (seconds, "cracker box")):
            start, worked = time.perf_counter(), time.process_time()
            found = segmenter.segment(view, Plan(phrase, ""))
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            times.append((time.perf_counter() - start, time.process_time() - worked))
            assert len(found.segments) <= MASKS_PER_PHRASE
    modules = [m for m in _modules(segmenter) if isinstance(m, torch.nn.Module)]
    return Row(
        sum(p.numel() for m in modules for p in m.parameters()),
        load_s,
        _median(firsts),
        _median(seconds),
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else None,
    )


def _median(times: list[tuple[float, float]]) -> tuple[float, float]:
    passed, worked = np.median(np.array(times[1:] or times), axis=0)
    return float(passed), float(worked)


def _modules(segmenter: Any) -> list[Any]:
    """Return the networks that a segmenter holds, the replaced backbone among them."""
    parts = [getattr(segmenter, n, None) for n in ("detector", "masks", "network")]
    return [m for p in parts if p is not None for m in (getattr(p, "_model", None), getattr(p, "backbone", None))]


def main(
    models: tuple[Model, ...] = ("grounded_sam", "grounded_sam2", "sam3"),
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480",
    frames: int = 4,
    threads: int | None = None,
    device: str = "cpu",
    dtype: str = "float32",
    out: Path | None = None,
) -> None:
    """Print the table.

    Args:
        models: Which rows.
        size: Of the frames.
        frames: So many per row; the first of several is left out.
        threads: Of torch; None = as many as it takes by itself.
        device: Where the networks run.
        dtype: What they calculate in.
        out: Also write the rows there, as JSON.
    """
    width, height = map(int, size.split("x"))
    load = os.getloadavg()[0]
    used = "torch's choice of" if threads is None else str(threads)
    print(f"{size}, {device}, {dtype}, {used} threads on {os.cpu_count()} cores, load {load:.1f} before\n")
    print("| networks | parameters | loading | first phrase (worked) | second phrase (worked) | peak memory |")
    print("|---|---|---|---|---|---|")
    context = multiprocessing.get_context("spawn")
    rows: dict[str, Row] = {}
    for name in models:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            with ProcessPoolExecutor(1, context) as pool:
                pool.submit(save, name, folder).result()
            with ProcessPoolExecutor(1, context) as pool:
                settings = {"device": device, "dtype": dtype}
                row = pool.submit(measure, name, folder, (width, height), frames, threads, settings).result()
            rows[name] = row
        gpu = "" if row.gpu_mib is None else f", GPU {row.gpu_mib:.0f} MiB"
        print(
            f"| {CONTENDERS[name].title} | {row.parameters / 1e6:.0f} M | {row.load_s:.1f} s "
            f"| {row.first_s[0]:.2f} s ({row.first_s[1]:.2f}) | {row.second_s[0]:.2f} s ({row.second_s[1]:.2f}) "
            f"| {row.peak_mib:.0f} MiB{gpu} |",
            flush=True,
        )
    if out is not None:
        out.write_text(json.dumps({name: vars(row) for name, row in rows.items()}, indent=2), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
