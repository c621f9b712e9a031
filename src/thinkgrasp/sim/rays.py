"""Ray casting into a MuJoCo world, over several threads."""

# pyright: reportAttributeAccessIssue=false
# MuJoCo's module is compiled and has no stubs.

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from thinkgrasp.motion.arm_spec import GROUP as ROBOT_GROUP

Float = NDArray[np.float64]

STATIC_GROUP, OBJECT_GROUP = 0, 2
SEEN_GROUPS = (STATIC_GROUP, ROBOT_GROUP, OBJECT_GROUP)
"""Geom groups that cameras see; collision shapes of the objects are in none of them."""
_MIN_RAYS_PER_THREAD = 4096
_CHUNKS_PER_THREAD = 8
_CUTOFF_M = 1e10
_ALLOWED = os.environ.get("OMP_NUM_THREADS", "")
_CPUS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
THREADS = int(_ALLOWED) if _ALLOWED.isdecimal() and int(_ALLOWED) > 0 else min(4, _CPUS)
"""As OMP_NUM_THREADS says, which a benchmark's workers set to one; else one per CPU, up to four."""


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays."""

    geoms: NDArray[np.int32]
    """(N,) geom id, -1 = none."""
    distances: Float
    """(N,) in lengths of the ray's direction; -1 = none."""
    normals: Float
    """(N, 3) unit, outward, world; (0, 3) unless asked for."""


def cast(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origin: Float,
    directions: Float,
    *,
    groups: tuple[int, ...] = SEEN_GROUPS,
    normals: bool = False,
    threads: int = THREADS,
) -> Hits:
    """Cast rays from one point; the result does not depend on the number of threads.

    Args:
        model: The world; its geom groups say what rays can meet.
        data: Its state, forwarded.
        origin: (3,) [m], world.
        directions: (N, 3), world, of any length but 0.
        groups: Geom groups that stop rays.
        normals: Whether to return surface normals.
        threads: Upper limit.
    """
    n = len(directions)
    geoms = np.empty((n, 1), np.int32)
    distances = np.empty((n, 1))
    normal = np.empty((3 * n, 1)) if normals else None
    flat = np.ascontiguousarray(directions, np.float64).reshape(-1, 1)
    point = np.array(origin, np.float64).reshape(3, 1)
    group = np.zeros((6, 1), np.uint8)
    group[list(groups)] = 1

    workers = max(1, min(threads, n // _MIN_RAYS_PER_THREAD))
    ends = np.linspace(0, n, workers * (_CHUNKS_PER_THREAD if workers > 1 else 1) + 1).astype(int).tolist()
    chunks = [(low, high) for low, high in pairwise(ends) if low < high]

    def work(state: mujoco.MjData, mine: list[tuple[int, int]]) -> None:
        for low, high in mine:
            slots = slice(3 * low, 3 * high)
            mujoco.mj_multiRay(
                model, state, point, flat[slots], group, True, -1, geoms[low:high], distances[low:high],
                None if normal is None else normal[slots], high - low, _CUTOFF_M,
            )  # fmt: skip

    if workers == 1:
        work(data, chunks)
    else:
        # Ray casting uses the scratch memory of its MjData: each thread needs its own.
        states = [data, *(copy.copy(data) for _ in range(workers - 1))]
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(work, states, [chunks[k::workers] for k in range(workers)]))
    return Hits(geoms[:, 0], distances[:, 0], np.empty((0, 3)) if normal is None else normal.reshape(-1, 3))
