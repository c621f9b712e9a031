from __future__ import annotations

import random
from dataclasses import replace

import pytest
from fakes import benchmark_results as made

from thinkgrasp.benchmark.failures import failure
from thinkgrasp.benchmark.metrics import exact_share, pairings, same_results, summarize, unsolved
from thinkgrasp.benchmark.records import CRASHED, NO_SCENE, EpisodeKey, EpisodeRecord, Records
from thinkgrasp.benchmark.results import Results
from thinkgrasp.types import Usage

FRUIT, PEAR = made.TASKS


def results(*records, methods=("offline",), runs=2) -> Results:
    plan = made.plan(methods, runs)
    keys = frozenset(EpisodeKey(m.name, t, s) for m in plan.methods for t in plan.tasks for s in plan.seeds)
    return Results(plan, Records([r for group in records for r in group]), keys, ())


@pytest.fixture
def four() -> Results:
    """Fruit: 1 grasp; failed after 3. Pear: 2 and 4 grasps. The limit is 15."""
    scenes = [made.scene(FRUIT, 1000), made.scene(FRUIT, 1001), made.scene(PEAR, 1000, fewest=2),
              made.scene(PEAR, 1001, is_fewest_exact=False)]  # fmt: skip
    return results(
        scenes,
        made.episode(1, task=FRUIT, seed=1000),
        made.episode(3, False, task=FRUIT, seed=1001, end="no_grasp"),
        made.episode(2, task=PEAR, seed=1000),
        made.episode(4, task=PEAR, seed=1001),
    )


def test_the_papers_metrics_by_hand(four):
    s = summarize(four, "offline")
    assert (s.planned, s.finished, s.n_success.k, s.n_success.n) == (4, 4, 3, 4)
    assert s.success.value == pytest.approx((0.5 + 1.0) / 2)
    assert s.steps.value == pytest.approx((2.0 + 3.0) / 2)
    assert s.steps_at_limit.value == pytest.approx(((1 + 15) / 2 + 3.0) / 2)
    assert s.success_steps.value == pytest.approx((1.0 + 3.0) / 2)
    assert [(t.task, t.success.k, t.steps, t.success_steps) for t in s.tasks] == [(FRUIT, 1, 2, 1), (PEAR, 2, 3, 3)]
    assert dict(s.ends) == {"goal_delivered": 3, "no_grasp": 1}


def test_tasks_weigh_the_same_however_many_runs_are_finished():
    found = results(
        made.episode(1, task=FRUIT), made.episode(3, False, task=FRUIT, seed=1001), made.episode(5, task=PEAR)
    )
    s = summarize(found, "offline")
    assert s.success.value == pytest.approx(0.75)
    assert s.n_success.value == pytest.approx(2 / 3)


def test_fewest_only_where_the_search_was_complete(four):
    s = summarize(four, "offline")
    assert (s.efficiency.episodes, s.efficiency.successes) == (2, 3)
    assert s.efficiency.ratio.value == pytest.approx(1.0)
    assert s.efficiency.extra.value == pytest.approx(0.0)
    assert (exact_share(four).k, exact_share(four).n) == (3, 4)


def test_grasps_and_deliveries():
    other = {**made.OTHER, "role": "goal"}
    found = results(
        [made.step(1, **made.MISSED), made.step(2, **other, toppled=("cup", "can")), made.step(3, moved_out=("box",))],
        [EpisodeRecord("offline", FRUIT, 1000, True, "goal_delivered", 3)],
        made.episode(1, task=FRUIT, seed=1001),
    )
    s = summarize(found, "offline")
    assert (s.grasps.k, s.grasps.n) == (3, 4)
    assert (s.goal_grasps.k, s.goal_grasps.n) == (2, 3)
    assert (s.wrong_deliveries.k, s.wrong_deliveries.n) == (1, 3)
    assert (s.toppled.value, s.pushed_out.value) == (1.0, 0.5)


def test_reasoning_against_chance():
    steps = [
        made.step(1, is_right=True, chance=0.5), made.step(2, is_right=False, chance=0.1),
        made.step(3, is_right=None, chance=None, status="no_target", reason=None),
        made.step(4, is_right=True, chance=0.3),
    ]  # fmt: skip
    found = results(steps, [EpisodeRecord("offline", FRUIT, 1000, True, "goal_delivered", 3)])
    reasoning = summarize(found, "offline").reasoning
    assert (reasoning.right.k, reasoning.right.n) == (2, 3)
    assert reasoning.chance == pytest.approx(0.3)


def test_all_right_is_as_sure_as_that_many_episodes(four):
    right = summarize(four, "offline").reasoning.right
    assert (right.k, right.n) == (10, 10)
    assert right.interval == pytest.approx((0.5101, 1.0), abs=1e-4)  # Wilson's of 4 of 4


def test_what_never_ran_is_a_failure_without_grasps():
    found = results(
        made.episode(2, task=FRUIT),
        [EpisodeRecord("offline", FRUIT, 1001, False, NO_SCENE, 0, error="no pile")],
        [
            made.step(1, task=PEAR, **made.MISSED),
            EpisodeRecord("offline", PEAR, 1000, False, CRASHED, 0, error="boom\nx"),
        ],
    )
    s = summarize(found, "offline")
    assert s.success.value == pytest.approx(0.25)
    assert s.steps.value == pytest.approx((2 + 1) / 2), "no pile: nothing to count; crashed: what was done before"
    assert s.steps_at_limit.value == pytest.approx(((2 + 15) / 2 + 15) / 2)
    assert [(f.stage, f.detail) for f in s.failures] == [("no episode", "no pile"), ("no episode", "boom")]


def test_times_by_stage():
    steps = [made.step(n, timings_ms=(("scene", 10.0 * n), ("total", 5.0)), seconds=n / 10) for n in range(1, 12)]
    found = results(steps, [EpisodeRecord("offline", FRUIT, 1000, True, "goal_delivered", 11)])
    times = summarize(found, "offline").times
    assert (times["scene"].median, times["scene"].p90) == (60.0, 100.0)
    assert times["rest"].median == pytest.approx(600)


def test_what_was_spent():
    paid, unknown = Usage("m", 100, 10, 0.5, 2), Usage("m", 50, 5, None, 1)
    first = made.episode(2, task=FRUIT, usage=paid)
    cost = summarize(results(first, made.episode(1, task=PEAR, usage=Usage())), "offline").cost
    assert (cost.requests, cost.prompt_tokens, cost.completion_tokens, cost.usd) == (2, 100, 10, 0.5)
    assert (cost.episodes, cost.steps) == (2, 3)
    cost = summarize(results(made.episode(2, usage=paid), made.episode(1, task=PEAR, usage=unknown)), "offline").cost
    assert cost.usd is None
    crashed = [made.step(1, usage=paid), EpisodeRecord("offline", FRUIT, 1000, False, CRASHED, 0, error="x")]
    assert summarize(results(crashed), "offline").cost.requests == 2


def test_pairs_only_where_both_finished():
    found = results(
        made.episode(1, task=FRUIT, seed=1000), made.episode(2, task=FRUIT, seed=1001),
        made.episode(2, False, task=PEAR), made.episode(9, task=PEAR, seed=1001),
        made.episode(3, method="oracle", task=FRUIT, seed=1000), made.episode(1, False, "oracle", FRUIT, 1001),
        made.episode(4, method="oracle", task=PEAR),
        methods=("offline", "oracle", "no-memory"),
    )  # fmt: skip
    (p,) = pairings(found, "offline")
    assert (p.method, p.reference, p.pairs) == ("oracle", "offline", 3)
    assert (p.both, p.only_method, p.only_reference, p.neither) == (1, 1, 1, 0)
    assert (p.success_difference, p.success_p) == (0.0, 1.0)
    assert p.steps_difference.value == pytest.approx(((2 + 13) / 2 - 11) / 2)
    assert p.steps_p == pytest.approx(6 / 8), "2, 13 and -11: sums of 4, 4, 22, 26, and their mirrors"
    assert (p.success_p_holm, p.steps_p_holm) == (p.success_p, p.steps_p)


def test_p_values_are_adjusted_for_the_number_of_methods():
    records = [made.episode(1, True, "offline", task, seed) for task in made.TASKS for seed in range(1000, 1003)]
    for method in ("oracle", "no-memory"):
        records += [made.episode(1, False, method, task, seed) for task in made.TASKS for seed in range(1000, 1003)]
    found = pairings(results(*records, methods=("offline", "oracle", "no-memory"), runs=3), "offline")
    assert [p.success_p for p in found] == pytest.approx([2 / 64] * 2)
    assert [p.success_p_holm for p in found] == pytest.approx([4 / 64] * 2)


def test_fallbacks_count_by_kind():
    steps = [made.step(1, degraded=("select: the next match (mug)", "plan: offline")),
             made.step(2, degraded=("select: the next match (pear)",))]  # fmt: skip
    found = results(steps, [EpisodeRecord("offline", FRUIT, 1000, True, "goal_delivered", 2)])
    s = summarize(found, "offline")
    assert dict(s.degraded) == {"select: the next match": 2, "plan: offline": 1}
    assert s.n_decisions == 2


def test_an_early_end_is_never_solved(four):
    left = unsolved(four, "offline")
    assert left[:5] == (1.0, 0.75, 0.5, 0.5, 0.25)
    assert left[-1] == 0.25
    assert len(left) == 16


UNSEEN = {"is_goal_in_view": False, "is_goal_takeable": False}
BESIDE = {**made.OTHER, "is_goal_takeable": True}


@pytest.mark.parametrize(
    ("stage", "steps", "changes", "detail"),
    [
        ("grasping", [made.MISSED, {**made.MISSED, "reason": "slipped"}, made.MISSED], {}, "missed 2, slipped 1"),
        (
            "reachability",
            [made.OTHER, {"status": "no_grasp", "reason": None, "target": "red apple"}],
            {},
            "'red apple'",
        ),
        ("recognition", [BESIDE, {**BESIDE, "role": "goal"}], {}, "taken for it: box 1"),
        ("clearing", [{**made.OTHER, **UNSEEN}], {}, "never in view|ever in view"),
        ("clearing", [{**made.OTHER, "is_goal_takeable": False}], {}, "never free"),
        ("lost goal", [{**made.OTHER, "moved_out": ("apple",)}], {"goals_lost": 1}, "held at box 1"),
        ("budget", [made.OTHER], {"end": "budget_spent"}, "budget_spent after 1"),
    ],
)
def test_which_stage_a_failure_is_of(stage, steps, changes, detail):
    own = [made.step(n, **step) for n, step in enumerate(steps, 1)]
    episode = replace(EpisodeRecord("offline", FRUIT, 1000, False, "step_limit", len(own)), **changes)
    found = failure(episode, own, made.scene())
    assert found.stage == stage
    assert any(part in found.detail for part in detail.split("|"))


def test_order_of_records_does_not_matter():
    plan = made.plan(("offline", "vlm@0.8"), 4)
    records = made.made_up(plan, {"offline": 0.8, "vlm@0.8": 0.5})
    blocks: dict[object, list[object]] = {}
    for record in records:
        blocks.setdefault(("scene", record.key) if record.kind == "scene" else record.key, []).append(record)
    shuffled = list(blocks.values())
    random.Random(3).shuffle(shuffled)
    keys = frozenset(EpisodeKey(m.name, t, s) for m in plan.methods for t in plan.tasks for s in plan.seeds)
    a, b = (Results(plan, Records(r), keys, ()) for r in (records, [r for block in shuffled for r in block]))
    for method in a.methods:
        assert summarize(a, method) == summarize(b, method)
    assert pairings(a, "offline") == pairings(b, "offline")
    assert same_results(a.records, b.records) == ()


def test_same_results_look_past_times_only():
    step, end = made.episode(1, usage=Usage("m", 1, 1, 0.1, 1, latency_s=1.0))
    one = [made.scene(), step, end]
    times = (("scene", 99.0), ("total", 100.0))
    other = [
        made.scene(seconds=9.0), replace(step, seconds=7.0, timings_ms=times),
        replace(end, seconds=5.0, usage=replace(end.usage, latency_s=8.0))
    ]  # fmt: skip
    assert same_results(Records(one), Records(other)) == ()
    for changed, word in (
        ([one[0], replace(step, touched="box"), end], "step 1: touched 'apple' and 'box'"),
        ([one[0], step, replace(end, success=False)], "success True and False"),
        ([replace(one[0], fewest=3), step, end], "pile clutter-06-fruit seed 1000: fewest 1 and 3"),
        ([one[0]], "only in the first"),
        ([one[0], replace(step, usage=Usage("n")), end], "usage"),
    ):
        (told,) = same_results(Records(one), Records(changed))
        assert word in told
