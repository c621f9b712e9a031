"""Grasp generators side by side on the same scenes: what each lifts, where each wins, and how long it takes.

    python benchmarks/generators.py --weights vgn_conv.pth --out generators.jsonl
    python benchmarks/generators.py --weights vgn_conv.pth --suite single --methods antipodal joint --scenes 30

`single`: one object at a time, every one of the catalogue once. `clutter`: piles of the ten clutter tasks; the planner
chooses what to take, which does not depend on the generator, and one grasp is tried. Masks and names are the
simulator's; grasps are proposed, checked and chosen on the measured depth as in the closed loop. It counts when what
was aimed at was held up to the bin, by contact. Beside that, every chosen grasp and its alternatives are judged alike
by the friction they need on the object's true mesh.

Every finished trial is one line of --out at once; the same command on the same file goes on where it was interrupted.
Grasps do not depend on the number of workers; times do: take those from a run with one.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from grasping import Job as LoneObject
from grasping import lone_object
from scipy.stats import binomtest
from trials import TrialLog, rate, run_all

from thinkgrasp.closure import TriangleMesh, grasp_friction
from thinkgrasp.config import PipelineConfig, StageConfig, load_config
from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import apply, invert
from thinkgrasp.robots.simulated import SimulatedRobot
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.oracle import oracle_pipeline
from thinkgrasp.sim.tasks import TASKS, find_task
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import World
from thinkgrasp.testbed import Session, for_the_loop
from thinkgrasp.types import Frame, Grasp, Grasps

SCHEMA = "thinkgrasp/bench-generator-1"
CLUTTER_SEEDS = 6
"""Piles per task: with ten tasks, 60 scenes."""
UNCHECKED = ("target", "width", "workspace")
PAD_LINES_M = (0.004, 0.010, 0.016, 0.022, 0.028)
"""How far behind the tips a pad is taken to touch the true mesh."""
GOOD_FRICTION = 0.4
Suite = Literal["single", "clutter"]


def _with_generator(name: str, weights: str, checks: Sequence[str] | None = None, **settings: object) -> PipelineConfig:
    config = replace(load_config("offline"), generator=StageConfig(name, {"weights": weights, **settings}))
    return config if checks is None else replace(config, checks=tuple(StageConfig(c) for c in checks))


METHODS: dict[str, tuple[str, Callable[[str], PipelineConfig]]] = {
    "antipodal": ("geometry alone, the preset offline", lambda _: load_config("offline")),
    "vgn": (
        "VGN as published: wide open, threshold 0.9, no check of force closure or collision",
        lambda w: _with_generator("vgn", w, UNCHECKED, fit=False, threshold=0.9, n_yaws=1, only_maxima=True),
    ),
    "vgn-checked": (
        "VGN proposes wide open, all its voxels; the checks dispose",
        lambda w: _with_generator("vgn", w, fit=False),
    ),
    "vgn-fitted": (
        "VGN proposes, the gripper is fitted to what it closes on; the checks dispose",
        lambda w: _with_generator("vgn", w),
    ),
    "union": (
        "candidates of antipodal and vgn-fitted, each with its own score",
        lambda w: _with_generator("vgn_antipodal", w, ranking="own"),
    ),
    "joint": (
        "the same candidates, ranked by both scores",
        lambda w: _with_generator("vgn_antipodal", w, ranking="joint"),
    ),
}
"""What is compared: a note, and the configuration for a file of weights."""


@dataclass(frozen=True)
class Job:
    """One trial."""

    suite: Suite
    scene: str
    seed: int
    method: str
    weights: str

    @property
    def key(self) -> tuple[str, str, int, str]:
        """As `Trial.key`."""
        return self.suite, self.scene, self.seed, self.method


@dataclass(frozen=True)
class Trial:
    """What became of it."""

    schema: str
    suite: Suite
    scene: str
    seed: int
    method: str
    target: str
    """Name of what was aimed at; empty where there was no target."""
    category: str
    build: str
    reason: str
    """The robot's outcome, "no_grasp", "no_target", "wrong_object" or "crashed"."""
    detail: str
    candidates: int
    kept: int
    """Candidates that passed all checks."""
    generate_ms: float
    check_ms: float
    decision_ms: float
    seconds: float
    closes_at: float | None = None
    """Friction that the chosen grasp needs on the object's true mesh; None = does not close, or there was none."""
    closed_share: float = 0.0
    """Of the chosen grasp and its alternatives, the share that closes there at GOOD_FRICTION."""

    @property
    def key(self) -> tuple[str, str, int, str]:
        """Two trials with one key are the same."""
        return self.suite, self.scene, self.seed, self.method

    @property
    def held(self) -> bool:
        """Whether what was aimed at was held up to the bin."""
        return self.reason == "held"


def build(obj: SimObject) -> str:
    """Return what an object's measures are like: flat, long, wide or compact."""
    low, high = obj.bounds_m
    x, y, z = high - low
    narrow, wide = sorted((x, y))
    if z < 0.03:
        return "long and flat" if wide > 3 * narrow else "flat"
    if narrow > 0.075:
        return "too wide for the gripper"
    return "long" if wide > 2.5 * narrow else "tall" if z > 1.8 * wide else "compact"


def run_job(job: Job) -> Trial:
    """Run one trial; what goes wrong is part of the record."""
    start = time.perf_counter()
    try:
        trial = _try(job)
    except Exception as error:  # one crash must not end a night of trials; it is counted and shown
        traceback.print_exc()
        trial = _trial(job, None, "crashed", f"{type(error).__name__}: {error}")
    return replace(trial, seconds=round(time.perf_counter() - start, 3))


def _try(job: Job) -> Trial:
    if job.suite == "single":
        world, frame = lone_object(LoneObject(job.scene, job.seed))
        robot, goals, instruction = SimulatedRobot(world), [0], f"the {job.scene}"
    else:
        session = Session(find_task(job.scene).scene(job.seed), seed=job.seed)
        world, frame, robot = session.world, session.cameras[0].read(), session.robot.robot
        goals, instruction = list(session.goals), session.scene.spec.instruction
    pipeline = oracle_pipeline(for_the_loop(METHODS[job.method][1](job.weights)), world, goals)
    decision = pipeline.decide(frame, instruction)
    aimed = None if decision.target is None else _shown(world, frame, decision.target.mask)
    funnel = decision.funnel
    times = dict(decision.timings_ms)
    measured: dict[str, Any] = {
        "candidates": funnel[0].n_out if funnel else 0,
        "kept": funnel[-1].n_out if funnel else 0,
        "generate_ms": round(times.get("generate", 0.0), 1),
        "check_ms": round(times.get("check", 0.0), 1),
        "decision_ms": round(times["total"], 1),
    }
    target = None if aimed is None else world.objects[aimed]
    if decision.grasp is None:
        detail = ", ".join(f"{step.check} {step.n_out}" for step in funnel)
        return replace(_trial(job, target, decision.status, detail), **measured)
    if aimed is not None:
        friction = _true_friction(world, frame, aimed, [decision.grasp, *decision.alternatives])
        measured["closes_at"] = float(friction[0]) if np.isfinite(friction[0]) else None
        measured["closed_share"] = round(float((friction <= GOOD_FRICTION).mean()), 3)
    outcome = robot.execute(decision.grasp, frame)
    reason = outcome.reason
    if reason == "held" and robot.truth.delivered != aimed:
        reason = "wrong_object"
    detail = f"score {decision.grasp.score:.2f}, opening {1e3 * decision.grasp.width_m:.0f} mm"
    return replace(_trial(job, target, reason, detail), **measured)


def _trial(job: Job, target: SimObject | None, reason: str, detail: str) -> Trial:
    name, category, kind = ("", "", "") if target is None else (target.name, target.category, build(target))
    return Trial(
        SCHEMA, job.suite, job.scene, job.seed, job.method, name, category, kind, reason, detail,
        0, 0, 0.0, 0.0, 0.0, 0.0,
    )  # fmt: skip


def _true_friction(world: World, frame: Frame, index: int, grasps: Sequence[Grasp]) -> np.ndarray:
    """Friction (N,) that grasps in camera coordinates need on an object's visible surface; inf = not closed."""
    assert frame.T_world_camera is not None  # the simulated camera always knows it
    T = invert(frame.T_world_camera) @ world.pose(index)
    visuals = world.objects[index].visuals
    starts = np.cumsum([0, *(len(v.vertices) for v in visuals)])
    vertices = apply(T, np.concatenate([v.vertices for v in visuals]).astype(np.float64))
    mesh = TriangleMesh(vertices, np.concatenate([v.faces + n for v, n in zip(visuals, starts[:-1], strict=True)]))
    names = ("rotation", "position", "width_m", "score")
    batch = Grasps(*(np.array([getattr(g, name) for g in grasps], np.float32) for name in names))
    return grasp_friction(batch, mesh, behind_tip_m=PAD_LINES_M)


def _shown(world: World, frame: Frame, mask: np.ndarray) -> int | None:
    """Index of the object that most of a mask truly shows."""
    if frame.T_world_camera is None:
        return None
    labels = true_labels(world, CameraView(frame.camera, frame.T_world_camera))[mask]
    labels = labels[labels >= 0]
    return int(np.bincount(labels).argmax()) if len(labels) else None


def report(trials: Sequence[Trial]) -> str:
    """Return the tables in Markdown: totals, pairs, by build and category, and the scenes that methods disagree on."""
    methods = list(dict.fromkeys(t.method for t in trials))
    lines: list[str] = []
    for suite in dict.fromkeys(t.suite for t in trials):
        own = [t for t in trials if t.suite == suite]
        by_method = {m: [t for t in own if t.method == m] for m in methods}
        lines += [f"## {suite}", "", *_totals(by_method), "", *_pairs(by_method), ""]
        lines += [*_split(by_method, "build"), "", *_split(by_method, "category"), "", *_disagreements(by_method), ""]
    return "\n".join([*lines, *(f"- {m}: {METHODS[m][0]}" for m in methods)])


def _totals(by_method: dict[str, list[Trial]]) -> list[str]:
    lines = [
        "| method | held of all scenes | no grasp | failures | closed on the true mesh: chosen, all answers "
        "| candidates, kept (median) | generate, check, decision (median ms) |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for method, trials in by_method.items():
        failed = Counter(t.reason for t in trials if not t.held and t.reason != "no_grasp")
        answered = [t for t in trials if t.decision_ms > 0] or trials
        medians = [
            f"{np.median([getattr(t, name) for t in answered]):.0f}"
            for name in ("candidates", "kept", "generate_ms", "check_ms", "decision_ms")
        ]
        lines.append(
            f"| {method} | {rate(sum(t.held for t in trials), len(trials))} "
            f"| {sum(t.reason == 'no_grasp' for t in trials)} "
            f"| {', '.join(f'{r} {n}' for r, n in failed.most_common())} "
            f"| {_closed(trials)} | {', '.join(medians[:2])} | {', '.join(medians[2:])} |"
        )
    return lines


def _closed(trials: Sequence[Trial]) -> str:
    """Share of chosen grasps, and of all answers, that close on the true mesh at GOOD_FRICTION."""
    answered = [t for t in trials if t.kept]
    if not answered:
        return ""
    chosen = np.mean([t.closes_at is not None and t.closes_at <= GOOD_FRICTION for t in answered])
    return f"{100 * chosen:.0f} %, {100 * np.mean([t.closed_share for t in answered]):.0f} %"


def _pairs(by_method: dict[str, list[Trial]]) -> list[str]:
    """Each method against the first, scene by scene; p by the sign test on scenes that one of them held (McNemar)."""
    first, *others = by_method
    base = {t.key[:3]: t.held for t in by_method[first]}
    lines = [
        f"| against {first} | both held | only it | only {first} | neither | p |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for method in others:
        pairs = Counter((t.held, base[t.key[:3]]) for t in by_method[method] if t.key[:3] in base)
        it, other = pairs[True, False], pairs[False, True]
        p = float(binomtest(it, it + other).pvalue) if it + other else 1.0
        lines.append(f"| {method} | {pairs[True, True]} | {it} | {other} | {pairs[False, False]} | {p:.2f} |")
    return lines


def _split(by_method: dict[str, list[Trial]], name: str) -> list[str]:
    """Held of trials by a property of the target."""
    values = sorted({getattr(t, name) for trials in by_method.values() for t in trials} - {""})
    lines = [f"| {name} | {' | '.join(by_method)} |", "| --- " * (1 + len(by_method)) + "|"]
    for value in values:
        cells: list[str] = []
        for trials in by_method.values():
            chosen = [t for t in trials if getattr(t, name) == value]
            cells.append(f"{sum(t.held for t in chosen)}/{len(chosen)}")
        lines.append(f"| {value} | {' | '.join(cells)} |")
    return lines


def _disagreements(by_method: dict[str, list[Trial]]) -> list[str]:
    lines: list[str] = []
    for key in dict.fromkeys(t.key[:3] for trials in by_method.values() for t in trials):
        trials = [t for own in by_method.values() for t in own if t.key[:3] == key]
        if len({t.held for t in trials}) > 1:
            told = ", ".join(f"{t.method} {t.reason}" + ("" if t.held else f" ({t.detail})") for t in trials)
            lines.append(f"- {key[1]} seed {key[2]}, {trials[0].target}: {told}")
    return lines and ["Scenes on which the methods differ:", "", *lines]


def run_jobs(jobs: Sequence[Job], workers: int, out: Path | None) -> list[Trial]:
    """Run what the file does not have yet; return the trials of all jobs, in their order."""
    log = TrialLog(out, Trial)
    done = {trial.key for trial in log.records}
    missing = [job for job in jobs if job.key not in done]
    for n, trial in enumerate(run_all(run_job, missing, workers), 1):
        log.add(trial)
        print(
            f"{n}/{len(missing)} {trial.suite} {trial.scene} seed {trial.seed} {trial.method}: {trial.reason} "
            f"({trial.detail}), {trial.seconds:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    found = {trial.key: trial for trial in log.records}
    return [found[job.key] for job in jobs]


def suite_scenes(suite: Suite, limit: int | None) -> list[tuple[str, int]]:
    """Return names and seeds of a suite's scenes; a limit takes them evenly from all."""
    every = (
        [(name, 0) for name in catalogue.names()]
        if suite == "single"
        else [(t.name, seed) for seed in range(CLUTTER_SEEDS) for t in TASKS if t.suite == "clutter"]
    )
    if limit is None or limit >= len(every):
        return every
    return [every[i] for i in np.linspace(0, len(every) - 1, limit).astype(int)]


def main(
    weights: Path,
    suite: Literal["single", "clutter", "both"] = "both",
    methods: tuple[str, ...] = tuple(METHODS),
    scenes: int | None = None,
    workers: int = 2,
    out: Path | None = None,
) -> None:
    """Run the trials and print the report.

    Args:
        weights: Of VGN.
        suite: Which scenes.
        methods: What is compared; the first is what the others are held against.
        scenes: At most so many scenes of each suite, taken evenly; none = all, 150 and 60.
        workers: Processes.
        out: JSON lines, one per finished trial.
    """
    if unknown := set(methods) - set(METHODS):
        raise ConfigError(f"no method {', '.join(sorted(unknown))}; allowed: {', '.join(METHODS)}")
    suites: tuple[Suite, ...] = ("single", "clutter") if suite == "both" else (suite,)
    jobs = [
        Job(s, name, seed, method, str(weights))
        for s in suites
        for name, seed in suite_scenes(s, scenes)
        for method in methods
    ]
    print(report(run_jobs(jobs, workers, out)))


if __name__ == "__main__":
    tyro.cli(main)
