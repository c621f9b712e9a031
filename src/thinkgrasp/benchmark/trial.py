"""One episode of a method over a pile, every step tied to what it was truly about."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from thinkgrasp.benchmark.methods import Method, running
from thinkgrasp.benchmark.reachability import Reachability, toppled
from thinkgrasp.benchmark.records import EpisodeRecord, Record, StepRecord
from thinkgrasp.benchmark.suites import Case
from thinkgrasp.sim.options import CameraOptions
from thinkgrasp.sim.scenes import PiledScene
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.testbed import Session
from thinkgrasp.types import Decision, Outcome

IN_VIEW_SHARE = 1 / 4000
"""A goal is in view where it fills this share of the image: 77 pixels of 640x480, 12 of 224x224."""


def run_trial(
    method: Method,
    case: Case,
    scene: PiledScene,
    seed: int,
    camera: CameraOptions,
    emit: Callable[[Record], None],
) -> None:
    """Run one episode.

    Args:
        method: What decides.
        case: What is asked for, and for how long.
        scene: The pile of this seed.
        seed: Of the sensors' noise too.
        camera: Which sensor.
        emit: Gets a record after every step, and one of the episode at its end.

    Raises:
        ThinkGraspError: A stage cannot be made, or failed.
    """
    start = time.perf_counter()
    session = Session(scene, camera, seed=seed)
    with running(method, session, case.name, seed) as pipeline:
        observer = _Observer(method.name, case.name, seed, session, emit)
        run = session.run(pipeline, step_limit=case.step_limit, recorders=[observer], stop=observer.look)
    world, episode = session.world, run.episode
    emit(
        EpisodeRecord(
            method.name,
            case.name,
            seed,
            success=episode.success,
            end=episode.end,
            steps=episode.attempts,
            goals_lost=sum(not world.on_table(goal) and not world.in_bin(goal) for goal in run.goals),
            usage=episode.usage,
            seconds=round(time.perf_counter() - start, 3),
        )
    )


class _Observer:
    """Notes before each step what every pixel shows and what could be taken, and after it what became of it."""

    def __init__(self, method: str, task: str, seed: int, session: Session, emit: Callable[[Record], None]) -> None:
        self._of = method, task, seed
        self._session = session
        self._emit = emit
        self._truth = Reachability(session.world, session.goals, session.views)
        self._labels: list[np.ndarray] = []
        self._poses = session.world.poses()
        self._since = 0.0
        self._step = 0

    def look(self) -> bool:
        """To be asked before every step; the episode goes on."""
        self._labels = [true_labels(self._session.world, view) for view in self._session.views]
        self._poses = self._session.world.poses()
        self._truth.refresh()
        self._since = time.perf_counter()
        return False

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Keep a finished step."""
        passed, session = time.perf_counter() - self._since, self._session
        looked_from, timings = decision.scene.frame.T_world_camera, dict(decision.timings_ms)
        poses = [view.T_world_camera for view in session.views]
        view = next(i for i, T in enumerate(poses) if looked_from is not None and np.array_equal(T, looked_from))
        aimed = _aimed(decision, self._labels[view])
        judged = self._truth.judge(aimed, view)
        is_chosen = decision.status == "grasp"
        attempt = session.robot.attempts[-1] if outcome is not None else None
        touched = attempt.truth.touched if attempt else None
        delivered = attempt.truth.delivered if attempt else None
        taken = {index for index in (touched, delivered) if index is not None}
        seen = max(int(np.count_nonzero(labels == goal)) for goal in session.goals for labels in self._labels)
        self._step += 1
        self._emit(
            StepRecord(
                *self._of,
                step=self._step,
                status=decision.status,
                role=decision.plan.role,
                target=decision.plan.target,
                aimed=self._name(aimed),
                is_goal_aimed=aimed in session.goals,
                is_goal_in_view=seen >= IN_VIEW_SHARE * self._labels[0].size,
                is_goal_takeable=judged.goal_takeable,
                is_right=judged.right if is_chosen else None,
                chance=round(judged.chance, 4) if is_chosen else None,
                reason=outcome.reason if outcome is not None else None,
                touched=self._name(touched),
                delivered=self._name(delivered),
                is_goal_touched=touched in session.goals,
                is_goal_delivered=delivered in session.goals,
                moved_out=tuple(self._name(i) for i in attempt.moved_out) if attempt else (),
                toppled=tuple(self._name(i) for i in toppled(self._poses, session.world.poses(), taken)),
                degraded=tuple(f"{d.stage}: {d.fallback}" for d in decision.degraded),
                timings_ms=tuple((stage, round(ms, 2)) for stage, ms in decision.timings_ms),
                seconds=round(passed - timings["total"] / 1e3, 4),
                usage=decision.plan.usage,
            )
        )

    def _name(self, index: int | None) -> str:
        return "" if index is None else self._session.world.objects[index].name


def _aimed(decision: Decision, labels: np.ndarray) -> int | None:
    """Return the object that most pixels of the target truly show."""
    if decision.target is None:
        return None
    of_target = labels[decision.target.mask]
    of_target = of_target[of_target >= 0]
    return int(np.bincount(of_target).argmax()) if len(of_target) else None
