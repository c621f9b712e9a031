"""The paper's metrics and ours, as numbers: pure functions of results.

Averages are those of the paper: over the runs of a task, then over the tasks. An episode that crashed or had no pile
is a failure. Where a failure ended early, `steps` counts the grasps it used, which flatters a method that gives up;
`steps_at_limit` counts every failure as if all attempts had been used.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thinkgrasp.benchmark.failures import Failure, failure
from thinkgrasp.benchmark.records import CRASHED, NO_SCENE, EpisodeKey, EpisodeRecord, SceneKey, StepRecord
from thinkgrasp.benchmark.results import Results
from thinkgrasp.benchmark.results import same_results as same_results
from thinkgrasp.benchmark.statistics import (
    Interval,
    holm,
    mcnemar,
    mean_interval,
    paired_difference,
    ratio_interval,
    signs_test,
    wilson,
)
from thinkgrasp.types import Usage


@dataclass(frozen=True)
class Mean:
    """A mean over tasks with its interval; None = there is nothing to average."""

    value: float | None
    interval: Interval | None


@dataclass(frozen=True)
class Rate:
    """k of n; the interval takes account of what belongs together."""

    k: int
    n: int
    interval: Interval | None

    @property
    def value(self) -> float | None:
        """The share, 0..1."""
        return self.k / self.n if self.n else None


@dataclass(frozen=True)
class TaskSummary:
    """One method on one task."""

    task: str
    success: Rate
    steps: float | None
    steps_at_limit: float
    success_steps: float | None


@dataclass(frozen=True)
class Efficiency:
    """Grasps of successes against the fewest possible, over piles where the search for those was complete."""

    ratio: Mean
    extra: Mean
    episodes: int
    successes: int
    """All of them, searched completely or not."""


@dataclass(frozen=True)
class Reasoning:
    """How often what was chosen was the goal where it could be taken, else a true obstruction."""

    right: Rate
    chance: float | None
    """Mean over the same steps of how often a blind pick would have been right."""
    over_chance: Interval | None


@dataclass(frozen=True)
class Time:
    """Of one stage [ms]."""

    median: float
    p90: float


@dataclass(frozen=True)
class Cost:
    """What the model's answers took; over all episodes."""

    requests: int
    prompt_tokens: int
    completion_tokens: int
    usd: float | None
    """None = not known for every episode that asked a model."""
    episodes: int
    steps: int


@dataclass(frozen=True)
class Summary:
    """One method over a suite."""

    method: str
    planned: int
    finished: int
    n_success: Rate
    """Over all episodes; its interval is Wilson's."""
    success: Mean
    """Mean over tasks of their rates."""
    steps: Mean
    steps_at_limit: Mean
    success_steps: Mean
    tasks: tuple[TaskSummary, ...]
    efficiency: Efficiency
    ends: Mapping[str, int]
    reasoning: Reasoning
    grasps: Rate
    """Executed grasps that held what they took until it was let go over the bin."""
    goal_grasps: Rate
    wrong_deliveries: Rate
    """Deliveries of what was planned as the goal and was none."""
    toppled: Mean
    """Objects per episode."""
    pushed_out: Mean
    times: Mapping[str, Time]
    """By stage of the decision, and "rest" for all else of a step."""
    cost: Cost
    degraded: Mapping[str, int]
    """How often each fallback was taken; what stands in brackets behind it is left out."""
    n_decisions: int
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class Pairing:
    """A method against the reference, on the piles where both finished."""

    method: str
    reference: str
    pairs: int
    both: int
    only_method: int
    only_reference: int
    neither: int
    success_difference: float
    success_interval: Interval
    success_p: float
    """Exact McNemar test."""
    steps_difference: Mean
    """Failures count as all attempts."""
    steps_p: float
    """Exact test of the differences' signs."""
    success_p_holm: float = 1.0
    """Adjusted for the number of methods."""
    steps_p_holm: float = 1.0


Value = Callable[[EpisodeRecord], float | None]


def summarize(results: Results, method: str) -> Summary:
    """Return all metrics of a method over its finished episodes."""
    episodes = results.episodes(method)
    told = [(episode, results.records.steps.get(key, [])) for key, episode in episodes.items()]
    steps = [step for _, own in told for step in own]
    of = _by_task(results, episodes)
    limit = results.step_limit

    def executed(episode: EpisodeRecord) -> float | None:
        return _executed(results, episode)

    def at_limit(episode: EpisodeRecord) -> float:
        return episode.steps if episode.success else limit

    def count(name: str) -> Mean:
        def value(episode: EpisodeRecord) -> float | None:
            own = results.records.steps.get(episode.key, [])
            return None if episode.end == NO_SCENE else sum(len(getattr(step, name)) for step in own)

        return _mean(of, value)

    def rate(asked: Callable[[StepRecord], bool], good: Callable[[StepRecord], bool]) -> Rate:
        return _step_rate(told, asked, good)

    k = sum(episode.success for episode in episodes.values())
    return Summary(
        method=method,
        planned=sum(key.method == method for key in results.planned),
        finished=len(episodes),
        n_success=Rate(k, len(episodes), wilson(k, len(episodes))),
        success=_mean(of, lambda episode: float(episode.success)),
        steps=_mean(of, executed),
        steps_at_limit=_mean(of, at_limit),
        success_steps=_mean(of, _success_steps),
        tasks=tuple(
            TaskSummary(
                task,
                Rate(sum(e.success for e in own), len(own), wilson(sum(e.success for e in own), len(own))),
                _average(map(executed, own)),
                float(np.mean([at_limit(e) for e in own])),
                _average(map(_success_steps, own)),
            )
            for task, own in of.items()
        ),
        efficiency=_efficiency(results, of),
        ends=Counter(episode.end for episode in episodes.values()),
        reasoning=_reasoning(told),
        grasps=rate(lambda s: s.is_executed, lambda s: s.reason == "held"),
        goal_grasps=rate(lambda s: s.is_executed and s.is_goal_aimed, lambda s: s.reason == "held"),
        wrong_deliveries=rate(lambda s: s.role == "goal" and bool(s.delivered), lambda s: s.is_wrong_delivery),
        toppled=count("toppled"),
        pushed_out=count("moved_out"),
        times=_times(steps),
        cost=_cost(told),
        degraded=Counter(what.partition(" (")[0] for step in steps for what in step.degraded),
        n_decisions=len(steps),
        failures=tuple(
            failure(episode, own, results.records.scenes.get(SceneKey(episode.task, episode.seed)))
            for episode, own in told
            if not episode.success
        ),
    )


def pairings(results: Results, reference: str) -> tuple[Pairing, ...]:
    """Return every other method against the reference, p-values adjusted for their number.

    References:
        [McNemar1947], [Pitman1937] and [Holm1979] in `thinkgrasp.benchmark.statistics`.
    """
    others = [method for method in results.methods if method != reference]
    theirs = {SceneKey(*key[1:]): e for key, e in results.episodes(reference).items()}
    found = [pair(method, reference, _keyed(results, method), theirs, results.step_limit) for method in others]
    success, steps = holm([p.success_p for p in found]), holm([p.steps_p for p in found])
    return tuple(
        Pairing(**{**vars(p), "success_p_holm": success[i], "steps_p_holm": steps[i]}) for i, p in enumerate(found)
    )


def pair(
    method: str,
    reference: str,
    mine: Mapping[SceneKey, EpisodeRecord],
    theirs: Mapping[SceneKey, EpisodeRecord],
    limit: int,
) -> Pairing:
    """Compare two sets of episodes pile by pile."""
    keys = sorted(mine.keys() & theirs.keys())
    steps: dict[str, list[float]] = defaultdict(list)
    counts: Counter[tuple[bool, bool]] = Counter()
    for key in keys:
        a, b = mine[key], theirs[key]
        counts[a.success, b.success] += 1
        steps[key.task].append((a.steps if a.success else limit) - (b.steps if b.success else limit))
    both, won, lost, neither = (counts[of] for of in ((True, True), (True, False), (False, True), (False, False)))
    return Pairing(
        method, reference, len(keys), both=both, only_method=won, only_reference=lost, neither=neither,
        success_difference=(won - lost) / len(keys) if keys else 0.0,
        success_interval=paired_difference(both, won, lost, neither), success_p=mcnemar(won, lost),
        steps_difference=_mean_of(steps), steps_p=signs_test([int(d) for own in steps.values() for d in own]),
    )  # fmt: skip


def unsolved(results: Results, method: str) -> tuple[float, ...]:
    """Return the share of episodes not solved after 0, 1, ... grasps, up to the limit.

    An episode that ended early without its goal is never solved: its end competes with success and is no censoring,
    which would credit a method that gives up with the successes of those that go on.
    """
    episodes = results.episodes(method).values()
    solved = Counter(episode.steps for episode in episodes if episode.success)
    taken = np.cumsum([solved[n] for n in range(results.step_limit + 1)])
    return tuple(float(1 - n / len(episodes)) for n in taken)


def exact_share(results: Results) -> Rate:
    """Return of how many piles the fewest grasps are known exactly."""
    scenes = [scene for scene in results.records.scenes.values() if not scene.error]
    k = sum(scene.is_fewest_exact and scene.fewest is not None for scene in scenes)
    return Rate(k, len(scenes), None)


def _keyed(results: Results, method: str) -> dict[SceneKey, EpisodeRecord]:
    return {SceneKey(*key[1:]): episode for key, episode in results.episodes(method).items()}


def _by_task(results: Results, episodes: Mapping[EpisodeKey, EpisodeRecord]) -> dict[str, list[EpisodeRecord]]:
    found: dict[str, list[EpisodeRecord]] = {}
    for key, episode in episodes.items():
        found.setdefault(key.task, []).append(episode)
    return found


def _executed(results: Results, episode: EpisodeRecord) -> float | None:
    """Return the grasps of an episode; of one that crashed those before it, None where there was no pile."""
    if episode.end == NO_SCENE:
        return None
    if episode.end == CRASHED:
        return sum(step.is_executed for step in results.records.steps.get(episode.key, []))
    return episode.steps


def _success_steps(episode: EpisodeRecord) -> float | None:
    return episode.steps if episode.success else None


def _mean(of: Mapping[str, Sequence[EpisodeRecord]], value: Value) -> Mean:
    return _mean_of({task: [v for e in own if (v := value(e)) is not None] for task, own in of.items()})


def _mean_of(values: Mapping[str, Sequence[float]]) -> Mean:
    means = [float(np.mean(own)) for own in values.values() if own]
    return Mean(float(np.mean(means)) if means else None, mean_interval(values))


def _average(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


Told = Sequence[tuple[EpisodeRecord, Sequence[StepRecord]]]


def _step_rate(told: Told, asked: Callable[[StepRecord], bool], good: Callable[[StepRecord], bool]) -> Rate:
    """Return a rate of steps; where all or none are good, its interval is that of as many episodes."""
    strata: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for episode, steps in told:
        chosen = [step for step in steps if asked(step)]
        strata[episode.task].append((sum(map(good, chosen)), len(chosen)))
    pairs = [pair for own in strata.values() for pair in own]
    k, n = sum(int(a) for a, _ in pairs), sum(int(b) for _, b in pairs)
    episodes = sum(bool(b) for _, b in pairs)
    interval = ratio_interval(strata) if 0 < k < n else wilson(episodes * (k > 0), episodes)
    return Rate(k, n, interval if n else None)


def _reasoning(told: Told) -> Reasoning:
    right = _step_rate(told, lambda step: step.is_right is not None, lambda step: bool(step.is_right))
    over: dict[str, list[tuple[float, float]]] = defaultdict(list)
    chances: list[float] = []
    for episode, steps in told:
        chosen = [(step.is_right, step.chance) for step in steps if step.is_right is not None]
        known = [(is_right, chance) for is_right, chance in chosen if chance is not None]
        chances += [chance for _, chance in known]
        over[episode.task].append((sum(is_right - chance for is_right, chance in known), len(known)))
    return Reasoning(right, float(np.mean(sorted(chances))) if chances else None, ratio_interval(over))


def _efficiency(results: Results, of: Mapping[str, Sequence[EpisodeRecord]]) -> Efficiency:
    ratio: dict[str, list[float]] = defaultdict(list)
    extra: dict[str, list[float]] = defaultdict(list)
    for task, episodes in of.items():
        for episode in episodes:
            scene = results.records.scenes.get(SceneKey(task, episode.seed))
            if episode.success and scene and scene.is_fewest_exact and scene.fewest:
                ratio[task].append(episode.steps / scene.fewest)
                extra[task].append(episode.steps - scene.fewest)
    successes = sum(episode.success for own in of.values() for episode in own)
    return Efficiency(_mean_of(ratio), _mean_of(extra), sum(map(len, ratio.values())), successes)


def _times(steps: Sequence[StepRecord]) -> dict[str, Time]:
    by_stage: dict[str, list[float]] = {}
    for step in steps:
        for stage, ms in step.timings_ms:
            by_stage.setdefault(stage, []).append(ms)
    rest = [1e3 * step.seconds for step in steps if step.is_executed]
    if rest:
        by_stage["rest"] = rest
    return {stage: Time(*(float(q) for q in np.percentile(ms, (50, 90)))) for stage, ms in by_stage.items()}


def _cost(told: Told) -> Cost:
    total = Usage()
    for episode, steps in told:
        own = episode.usage if episode.end != CRASHED else sum((step.usage for step in steps), Usage())
        total += own
    return Cost(
        total.requests,
        total.prompt_tokens,
        total.completion_tokens,
        total.usd if total.requests else 0.0,
        len(told),
        sum(step.is_executed for _, steps in told for step in steps),
    )
