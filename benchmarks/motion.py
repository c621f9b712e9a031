"""How fast the arm's motions are planned, and how often there is one.

    python benchmarks/motion.py [--grasps 200] [--seed 0]

Grasps are random in the workspace, up to a tilt from straight down, over clouds of random blocks; no object has to be
there, so that a grasp may well lie inside of a block: the gripper at the object is the grasp checks' business. "wall"
puts a wall between the home pose and the workspace, so that no straight joint move leads there.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.motion import ur5e
from thinkgrasp.motion.arm import ArmMotion, GraspMotion
from thinkgrasp.motion.cell import HOME_RAD, WORKSPACE_M
from thinkgrasp.motion.trajectory import time_path

DROP_RAD = (-2.39, -0.95, 0.95, -1.57, -1.57, -2.39)
"""Over the middle of the bin."""

Float = NDArray[np.float64]

HOME, DROP = np.array(HOME_RAD), np.array(DROP_RAD)
OPENING_M = 0.06
CASES = (("top-down", 0, 0, False), ("tilt 30", 30, 10, False), ("tilt 60", 60, 10, False), ("wall", 30, 10, True))
"""Name, largest tilt in degrees, blocks, and whether there is the wall."""


def random_grasps(n: int, tilt_deg: float, rng: np.random.Generator) -> Float:
    """Return T_world_tcp (n, 4, 4) in the workspace, 1 to 12 cm above the table."""
    lean, about, yaw = rng.uniform(0, np.deg2rad(tilt_deg), n), *rng.uniform(0, 2 * np.pi, (2, n))
    axis = np.stack([np.cos(about), np.sin(about), np.zeros(n)], axis=1)
    down = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", yaw[:, None])
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = (Rotation.from_rotvec(lean[:, None] * axis) * down).as_matrix()
    (x0, x1), (y0, y1) = WORKSPACE_M
    T[:, :3, 3] = rng.uniform([x0, y0, 0.01], [x1, y1, 0.12], (n, 3))
    return T


def random_cloud(blocks: int, wall: bool, rng: np.random.Generator) -> Float:
    """Return points (P, 3) on blocks of 4 to 10 cm width and 3 to 15 cm height."""
    points = [np.zeros((0, 3))]
    for _ in range(blocks):
        half, height = rng.uniform(0.02, 0.05), rng.uniform(0.03, 0.15)
        corner = rng.uniform([0.3, -0.2, 0.0], [0.7, 0.2, 0.0])
        points.append(rng.uniform([-half, -half, 0], [half, half, height], (2000, 3)) + corner)
    if wall:
        points.append(rng.uniform([0.2, 0.29, 0.0], [0.75, 0.31, 0.45], (60_000, 3)))
    return np.concatenate(points)


def main(grasps: int = 200, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    arm = ArmMotion()

    T = ur5e.forward(rng.uniform(-np.pi, np.pi, (4000, 6)))
    print(f"inverse kinematics   {len(T) / _seconds(lambda: ur5e.inverse(T)):9.0f} poses/s, all branches")

    near_home = HOME + rng.normal(0, 0.4, (3000, 6))
    arm.world.see(random_cloud(10, False, rng))
    print(f"collision checks     {len(near_home) / _seconds(lambda: arm.world.collides(near_home, OPENING_M)):9.0f} /s")

    path = rng.uniform(-1, 1, (8, 6))
    print(f"timing of 8 points   {1e3 * _seconds(lambda: time_path(path, ur5e.LIMITS)):9.2f} ms")

    T, cloud = random_grasps(300, 45, rng), random_cloud(10, False, rng)
    openings = np.full(len(T), OPENING_M)
    reached = arm.reaches(HOME, T, openings, cloud)
    took = _seconds(lambda: arm.reaches(HOME, T, openings, cloud))
    print(f"reach of 300 grasps  {1e3 * took:9.0f} ms, {reached.mean():.2f} reachable")

    print("\ncase        found  p50 ms  p95 ms  max ms  motion s  to bin s  not found because")
    for name, tilt_deg, blocks, wall in CASES:
        took_ms, motion_s, transfer_s, reasons = [], [], [], Counter[str]()
        for T in random_grasps(grasps, tilt_deg, rng):
            cloud = random_cloud(blocks, wall, rng)
            start = time.perf_counter()
            plan = arm.plan_grasp(HOME, T, OPENING_M, cloud)
            took_ms.append(1e3 * (time.perf_counter() - start))
            if not isinstance(plan, GraspMotion):
                reasons[plan] += 1
                continue
            motion_s.append(plan.to_pregrasp.duration_s + plan.approach.duration_s + plan.lift.duration_s)
            way = arm.plan_to(plan.lift.end, DROP, OPENING_M, cloud)
            if isinstance(way, str):
                reasons[f"to the bin: {way}"] += 1
            else:
                transfer_s.append(way.duration_s)
        p50, p95, most = np.percentile(took_ms, [50, 95, 100])
        print(
            f"{name:10} {len(motion_s) / grasps:6.2f} {p50:7.0f} {p95:7.0f} {most:7.0f} {np.mean(motion_s):9.2f} "
            f"{np.mean(transfer_s):9.2f}  {', '.join(f'{k} {n}' for k, n in reasons.items()) or '-'}"
        )


def _seconds(what: Callable[[], object], repeats: int = 5) -> float:
    """Median time of a call."""
    took = []
    for _ in range(repeats):
        start = time.perf_counter()
        what()
        took.append(time.perf_counter() - start)
    return float(np.median(took))


if __name__ == "__main__":
    tyro.cli(main)
