"""What VGN costs: the fusion of views, the network, its post-processing, a whole call of the generator, and memory.

    python benchmarks/vgn_cost.py --weights vgn_conv.pth [--threads 2] [--repeats 30]

Times are medians of wall time in this process after one call to warm up; memory is the resident set of this process,
torch included. Without weights the network is untrained, which costs the same.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import tyro

from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.testing import sample_scene


def median_ms(call: Callable[[], object], repeats: int) -> float:
    """Return the median wall time [ms] of a call, after one that does not count."""
    call()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def resident_mb() -> float:
    """Return the memory of this process [MB]."""
    return psutil.Process().memory_info().rss / 1e6


def main(weights: Path | None = None, threads: int = 2, repeats: int = 30, device: str = "cpu") -> None:
    """Measure and print a table in Markdown.

    Args:
        weights: Of VGN; none = an untrained network.
        threads: Of torch.
        repeats: Calls per row.
        device: Of the network.
    """
    memory = {"numpy and the package": resident_mb()}
    import torch

    from thinkgrasp.generators.cubes import place_cubes
    from thinkgrasp.generators.surface import Upright
    from thinkgrasp.generators.vgn import VgnGenerator
    from thinkgrasp.networks import vgn
    from thinkgrasp.networks.tsdf import fuse

    torch.set_num_threads(threads)
    memory["torch imported"] = resident_mb()
    network = vgn.load_vgn(weights, device) if weights else vgn.Vgn().eval().requires_grad_(False).to(device)
    memory["network loaded"] = resident_mb()

    scene = sample_scene()
    camera, depth = scene.frame.camera, scene.frame.depth
    mask = scene.proposals[0].mask
    seen = scene.points[mask & np.isfinite(scene.points[..., 2])]
    (T,) = place_cubes(
        seen, Upright.of(scene, seen), side_m=vgn.CUBE_M, support_m=vgn.SUPPORT_M, yaws_rad=(0.0,), max_cubes=1
    )

    def field(views: int) -> Callable[[], object]:
        images, transforms = np.repeat(depth[None], views, axis=0), np.repeat(T[None], views, axis=0)
        return lambda: fuse(images, camera, transforms, length_m=vgn.CUBE_M, resolution=vgn.RESOLUTION).grid()

    grid = fuse(depth[None], camera, T[None], length_m=vgn.CUBE_M, resolution=vgn.RESOLUTION).grid()
    (raw,) = vgn.predict(network, grid[None])
    memory["after a forward"] = resident_mb()
    rows = [(f"TSDF, {n} view{'s' if n > 1 else ''} of {camera.width}x{camera.height}", field(n)) for n in (1, 3)]
    rows += [(f"network, {n} cube{'s' if n > 1 else ''}", _forward(network, grid, n)) for n in (1, 3, 16)]
    rows += [
        ("post-processing of a cube", lambda: vgn.select_voxels(vgn.process_quality(grid, raw), raw)),
        ("depth to voxels, 1 cube", lambda: vgn.detect(network, depth[None], camera, T[None])),
    ]
    if weights is not None:
        gripper = GRIPPERS["robotiq_2f85"]
        for n in (1, 3):
            generator = VgnGenerator(weights=weights, n_yaws=n, device=device)
            name = f"generator, one object, {n} cube{'s' if n > 1 else ''}"
            rows.append((name, lambda g=generator: g.generate(scene, mask, gripper, np.random.default_rng(0))))
    print(f"torch {torch.__version__}, {device}, {threads} threads; load {os.getloadavg()[0]:.1f}\n")
    print("| part | median ms |\n| --- | --- |")
    for name, call in rows:
        print(f"| {name} | {median_ms(call, repeats):.1f} |", flush=True)
    memory["after all of this"] = resident_mb()
    print("\n| resident memory | MB |\n| --- | --- |")
    for name, mb in memory.items():
        print(f"| {name} | {mb:.0f} |")


def _forward(network: object, grid: np.ndarray, n: int) -> Callable[[], object]:
    from thinkgrasp.networks import vgn

    assert isinstance(network, vgn.Vgn)
    cubes = np.repeat(grid[None], n, axis=0)
    return lambda: vgn.predict(network, cubes)


if __name__ == "__main__":
    tyro.cli(main)
