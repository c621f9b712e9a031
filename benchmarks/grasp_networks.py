"""Time and memory of GraspNet-1Billion and FGC-GraspNet, side by side with a straightforward implementation.

    python benchmarks/grasp_networks.py [--threads 2] [--sizes 5000 10000 20000 40000] [--repeats 9] [--clock wall]
                                        [--device cpu] [--golden DIR] [--out out/grasp_networks.svg]

Both implementations hold the same weights and see the same cloud, a rendered table cut to 0.45 m about its middle;
their runs take turns. The straightforward one is written here: every distance of every query, modules as they are, the
second stage on every seed, and four cylinders each on its own. Weights are random: those of the golden data in DIR,
whose seeds are graspable in part, or else ones made here, for which all are. Peak memory is that of a fresh process
with its imports. On a machine that is busy with other work, use --threads 1 --clock cpu: seconds of the processor.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cost_plot
import numpy as np
import torch
import tyro
from torch import Tensor

from thinkgrasp.geometry import deproject
from thinkgrasp.networks.fgc_graspnet import FGCGraspNet
from thinkgrasp.networks.grasp_views import approach_rotations, view_directions
from thinkgrasp.networks.graspnet import GraspNet
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render

NETWORKS: dict[str, type[GraspNet] | type[FGCGraspNet]] = {"graspnet": GraspNet, "fgc": FGCGraspNet}
GOLDEN = Path(__file__).resolve().parents[2] / "shared" / "grasp_networks"
REACH_M = 0.45
Clock = Literal["wall", "cpu"]


def table_cloud(n: int, seed: int = 0) -> np.ndarray:
    """Return n points (n, 3) float32 [m] of a rendered table, in random order."""
    frame = render(demo_scene(0), *demo_camera()).frame
    points = deproject(frame.depth, frame.camera).reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])]
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < REACH_M]
    return points[np.random.default_rng(seed).choice(len(points), n, replace=n > len(points))]


def load(name: str, golden: Path) -> GraspNet | FGCGraspNet:
    """Return a network with the golden data's weights, or random ones for which every seed is graspable."""
    file = golden / f"golden_{name}.npz"
    if file.is_file():
        data = np.load(file)
        weights = {key[2:]: torch.from_numpy(data[key]) for key in data.files if key.startswith("w/")}
    else:
        torch.manual_seed(0)
        weights = NETWORKS[name]().state_dict()
        prefix = "view_estimator." if name == "graspnet" else ""
        weights[f"{prefix}vpmodule.conv3.weight"][:2] = 0
        weights[f"{prefix}vpmodule.conv3.bias"][:2] = torch.tensor([0.0, 1.0])
    return NETWORKS[name].from_weights(weights)


class Straightforward:
    """The same networks, operator by operator."""

    def __init__(self, network: GraspNet | FGCGraspNet) -> None:
        self.network = network

    @torch.inference_mode()
    def run(self, cloud: np.ndarray) -> tuple[Tensor, Tensor]:
        """Return what the last head says of every seed (1, C, seeds or 4 * seeds), and the best view of each."""
        net: Any = self.network
        first = net.view_estimator if isinstance(net, GraspNet) else net
        xyz, features = torch.from_numpy(cloud), None
        levels: list[tuple[Tensor, Tensor]] = []
        for layer in (first.backbone.sa1, first.backbone.sa2, first.backbone.sa3, first.backbone.sa4):
            xyz, features = _abstract(layer, xyz, features)
            levels.append((xyz, features))
        deep = _propagate(first.backbone.fp1, levels[2], levels[3])
        deep = _propagate(first.backbone.fp2, levels[1], (levels[2][0], deep))
        view = _head(first.vpmodule, deep)[0, 2:].argmax(dim=0)
        seeds = levels[1][0]
        rotations = approach_rotations(-torch.from_numpy(view_directions())[view], torch.zeros(len(view)))
        if isinstance(net, GraspNet):
            points, known, highs, slots = torch.from_numpy(cloud), None, (0.01, 0.02, 0.03, 0.04), 64
        else:
            (points, known), highs, slots = levels[0], (0.02,), 32
        index = [_cylinder(points, seeds, rotations, high, slots) for high in highs]
        groups = torch.stack([_group(points, known, seeds, i, rotations) for i in index], dim=3).flatten(2, 3)
        if isinstance(net, GraspNet):
            pooled = _mlp(net.grasp_generator.crop.mlps, groups).amax(dim=3)
            _head(net.grasp_generator.tolerance, pooled)
            return _head(net.grasp_generator.operation, pooled), view
        return _head(net.operation, _attend(net.local_att, groups).amax(dim=3)), view


def _furthest(xyz: Tensor, count: int) -> Tensor:
    x, y, z = (np.ascontiguousarray(axis) for axis in xyz.numpy().T)
    far = np.where(x * x + y * y + z * z > 1e-3, np.float32(1e10), np.float32(-1))
    picked = np.zeros(count, np.int64)
    for i in range(1, count):
        k = picked[i - 1]
        far = np.minimum(far, (x - x[k]) ** 2 + (y - y[k]) ** 2 + (z - z[k]) ** 2)
        picked[i] = far.argmax()
    return torch.from_numpy(picked)


def _first(hit: np.ndarray, count: int) -> np.ndarray:
    index = np.zeros((len(hit), count), np.int64)
    for row, found in zip(index, hit, strict=True):
        where = np.flatnonzero(found)[:count]
        if len(where):
            row[:] = where[0]
            row[: len(where)] = where
    return index


def _ball(xyz: Tensor, centers: Tensor, radius: float, count: int) -> Tensor:
    rows = []
    for some in centers.split(128):
        x, y, z = (xyz[:, axis] - some[:, axis : axis + 1] for axis in range(3))
        rows.append(_first((x * x + y * y + z * z < radius**2).numpy(), count))
    return torch.from_numpy(np.concatenate(rows))


def _cylinder(xyz: Tensor, centers: Tensor, rotations: Tensor, high: float, count: int) -> Tensor:
    rows = []
    for some, rotation in zip(centers.split(128), rotations.split(128), strict=True):
        d = [xyz[:, axis] - some[:, axis : axis + 1] for axis in range(3)]
        x, y, z = (
            rotation[:, 0, a, None] * d[0] + rotation[:, 1, a, None] * d[1] + rotation[:, 2, a, None] * d[2]
            for a in range(3)
        )
        inside = (y * y + z * z < 0.05**2) & (x > -0.02) & (x < high)
        rows.append(_first(inside.numpy(), count))
    return torch.from_numpy(np.concatenate(rows))


def _group(xyz: Tensor, features: Tensor | None, centers: Tensor, index: Tensor, rotations: Tensor) -> Tensor:
    local = torch.matmul(xyz[index] - centers[:, None], rotations).permute(2, 0, 1)
    return local[None] if features is None else torch.cat([local, features[0][:, index]])[None]


def _mlp(mlp: Any, groups: Tensor) -> Tensor:
    for layer in mlp.children():
        groups = torch.relu(layer.bn(layer.conv(groups)))
    return groups


def _abstract(layer: Any, xyz: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
    centers = xyz[_furthest(xyz, layer.n_points)]
    index = _ball(xyz, centers, layer.radius, layer.n_samples)
    groups = ((xyz[index] - centers[:, None]) / layer.radius).permute(2, 0, 1)
    if features is not None:
        groups = torch.cat([groups, features[0][:, index]])
    return centers, _mlp(layer.mlp_module, groups[None]).amax(dim=3)


def _propagate(layer: Any, to: tuple[Tensor, Tensor], known: tuple[Tensor, Tensor]) -> Tensor:
    squared, index = (to[0][:, None] - known[0][None]).square().sum(dim=2).topk(3, largest=False)
    weight = 1 / (squared.sqrt() + 1e-8)
    weight = weight / weight.sum(dim=1, keepdim=True)
    carried = (known[1][0][:, index] * weight).sum(dim=2)
    return _mlp(layer.mlp, torch.cat([carried, to[1][0]])[None, ..., None])[..., 0]


def _head(head: Any, features: Tensor) -> Tensor:
    features = torch.relu(head.bn1(head.conv1(features)))
    return head.conv3(torch.relu(head.bn2(head.conv2(features))))


def _attend(local: Any, groups: Tensor) -> Tensor:
    x = _mlp(local.mlps, groups)[0].transpose(0, 1)
    net = local.local_att
    query = net.q_conv(x)
    weights = torch.softmax(torch.bmm(query.transpose(1, 2), net.k_conv(x)), dim=2)
    mixed = torch.bmm(net.v_conv(x), weights)
    out = x + torch.relu(net.after_norm(net.trans_conv(x - mixed)))
    return out.transpose(0, 1)[None]


def take_turns(
    network: GraspNet | FGCGraspNet, plain: Straightforward, cloud: np.ndarray, repeats: int, clock: Clock
) -> list[list[float]]:
    """Return the times [ms] of ours, ours with every seed, and the straightforward one, run in turn and warm."""
    runs: list[Callable[[], object]] = [
        lambda: network.run(cloud).grasps.cpu(),
        lambda: network.run(cloud, trace=True).grasps.cpu(),
        lambda: plain.run(cloud),
    ]
    now = time.perf_counter if clock == "wall" else time.process_time
    times: list[list[float]] = [[] for _ in runs]
    for turn in range(repeats + 1):
        for run, spent in zip(runs, times, strict=True):
            start = now()
            run()
            if turn:
                spent.append((now() - start) * 1e3)
    return times


def same(network: GraspNet | FGCGraspNet, cloud: np.ndarray) -> str:
    """Say how far both implementations agree, on the CPU."""
    ours = network.run(cloud, trace=True)
    heads = [ours.grasp_score_pred, ours.grasp_angle_cls_pred, ours.grasp_width_pred]
    if isinstance(network, FGCGraspNet):
        mine = torch.cat([*heads, ours.grasp_depth_cls_pred])  # type: ignore[union-attr]
    else:
        mine = torch.cat(heads).flatten(1)
    theirs, view = Straightforward(network).run(cloud)
    views = int((view != ours.grasp_top_view_inds).sum())
    return f"largest difference of the heads {float((mine - theirs[0]).abs().max()):.1e}, other views {views} of 1024"


def peak_mb(name: str, plain: bool, n: int, threads: int, golden: Path, device: str) -> float:
    """Run once in this process and return its peak memory [MB]."""
    torch.set_num_threads(threads)
    cloud = table_cloud(n)
    network = load(name, golden)
    (Straightforward(network) if plain else network.to(device)).run(cloud)
    status = Path("/proc/self/status")
    if status.is_file():
        (line,) = [text for text in status.read_text().splitlines() if text.startswith("VmHWM")]
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(
    threads: int = 2,
    sizes: tuple[int, ...] = (5000, 10_000, 20_000, 40_000),
    repeats: int = 9,
    clock: Clock = "wall",
    device: str = "cpu",
    golden: Path = GOLDEN,
    out: Path = Path("out/grasp_networks.svg"),
) -> None:
    """Print the tables and write the plot."""
    torch.set_num_threads(threads)
    load_1m = os.getloadavg()[0]
    where = torch.cuda.get_device_name() if device != "cpu" else f"{threads} threads, load average {load_1m:.1f}"
    print(f"torch {torch.__version__}, {where}, {clock} time [ms]")
    curves: dict[str, list[tuple[float, float]]] = {}
    print(
        f"{'network':<10}{'points':>8}{'seeds':>7}{'ours':>8}{'least':>8}{'all seeds':>11}{'straight':>10}{'ratio':>7}"
    )
    for name in NETWORKS:
        for n in sizes:
            cloud = table_cloud(n)
            network, plain = load(name, golden).to(device), Straightforward(load(name, golden))
            seeds = len(network.run(cloud).rows)
            times = take_turns(network, plain, cloud, repeats, clock)
            ours, every, theirs = (float(np.median(t)) for t in times)
            print(
                f"{name:<10}{n:>8}{seeds:>7}{ours:>8.0f}{min(times[0]):>8.0f}{every:>11.0f}{theirs:>10.0f}"
                f"{theirs / ours:>7.1f}",
                flush=True,
            )
            curves.setdefault(name, []).append((n, ours))
            curves.setdefault(f"{name}, straightforward", []).append((n, theirs))
        print(f"{name}: {same(load(name, golden), table_cloud(sizes[0]))}")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(
        cost_plot.plot(curves, f"Grasp networks, {where.split(',')[0]}, {clock} time", "points of the cloud")
    )
    print(f"plot: {out}")
    context = multiprocessing.get_context("spawn")
    for name in NETWORKS:
        for plain_too in (False, True):
            with context.Pool(1) as pool:
                peak = pool.apply(peak_mb, (name, plain_too, 20_000, threads, golden, device))
            print(f"peak memory {name:<10}{'straightforward' if plain_too else 'ours':<16}{peak:>6.0f} MB")


if __name__ == "__main__":
    tyro.cli(main)
