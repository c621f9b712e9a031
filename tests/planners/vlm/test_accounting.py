"""What requests cost, and a budget that ends them."""

from __future__ import annotations

import pytest
from fakes.chat_server import good, serving
from fakes.openai_planner import ASK, GOOD, GREEN, REPLY, SCENE, is_fallback, plan_of, planner, reasons

from thinkgrasp.memory import Memory

pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")


def test_unreported_usage_is_unknown_and_not_free():
    plan, _ = plan_of(good(REPLY, usage=False))
    assert plan.mark == GREEN
    assert plan.usage.usd is None
    assert "does not say how many tokens" in reasons(plan)
    plan, _ = plan_of(good(REPLY, usage=False), model="my-own")
    assert plan.usage.usd is None
    assert plan.degraded == ()


@pytest.mark.parametrize(
    ("settings", "usd"),
    [
        ({"model": "gpt-4o-2024-08-06"}, 0.0035),
        ({"model": "my-own"}, None),
        ({"model": "my-own", "prices": {"my-own": {"input": 1, "output": 0}}}, 0.001),
        ({"prices": {"gpt-4o": {"input": 0, "output": 10}}}, 0.001),
    ],
)
def test_dollars(settings, usd):
    plan, _ = plan_of(GOOD, **settings)
    assert plan.usage.usd == (usd if usd is None else pytest.approx(usd))


def test_prices_come_from_a_file(tmp_path):
    path = tmp_path / "prices.toml"
    path.write_text('["my-own"]\ninput = 2\noutput = 20\n')
    plan, _ = plan_of(GOOD, model="my-own", prices=path)
    assert plan.usage.usd == pytest.approx(0.004)


@pytest.mark.parametrize("on_budget", ["stop", "offline"])
def test_a_spent_budget_ends_the_questions(on_budget):
    with serving(GOOD) as server:
        asked = planner(server, budget_usd=0.006, on_budget=on_budget)
        plans = [asked.plan(SCENE, ASK, Memory()) for _ in range(3)]
        asked.close()
    assert [p.usage.requests for p in plans] == [1, 1, 0]
    assert asked.spent.usd == pytest.approx(0.007)
    assert "the budget of 0.006 USD allows no more requests: 0.0070 USD are spent" in reasons(plans[2])
    assert [p.out_of_budget for p in plans] == [False, False, on_budget == "stop"]
    assert plans[2].found == is_fallback(plans[2]) == (on_budget == "offline")


def test_a_budget_that_cannot_be_kept_ends_the_questions_too():
    with serving(good(REPLY, usage=False)) as server:
        asked = planner(server, budget_usd=1)
        plans = [asked.plan(SCENE, ASK, Memory()) for _ in range(2)]
        asked.close()
    assert [p.usage.requests for p in plans] == [1, 0]
    assert "an unknown sum is spent" in reasons(plans[1])
