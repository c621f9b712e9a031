"""Servers that are busy, late, broken or choosy, on real sockets."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fakes.chat_server import Step, dead_url, error, good, serving
from fakes.openai_planner import ASK, GOOD, GREEN, SCENE, Clock, is_fallback, plan_of, planner, reasons

from thinkgrasp.memory import Memory

pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")


def test_waits_as_long_as_a_busy_server_asks():
    clock = Clock()
    date = "Sun, 06 Nov 1994 08:49:44 GMT"  # 7 s after the server's own Date
    plan, server = plan_of(error(429, retry_after="2"), error(429, retry_after=date), GOOD, clock=clock)
    assert clock.waits == [2.0, 7.0]
    assert plan.mark == GREEN
    assert len(server.requests) == plan.usage.requests == 3
    assert "2 requests failed, the last with: HTTP 429" in reasons(plan)
    assert "asked again" in reasons(plan)


def test_does_not_wait_longer_than_the_decision_may_take_and_remembers_it():
    clock = Clock()
    with serving(error(429, retry_after="100"), GOOD) as server:
        asked = planner(server, clock)
        first = asked.plan(SCENE, ASK, Memory())
        second = asked.plan(SCENE, ASK, Memory())
        clock.now += 100
        third = asked.plan(SCENE, ASK, Memory())
        asked.close()
    assert is_fallback(first)
    assert "waiting 100 s" in reasons(first)
    assert is_fallback(second)
    assert "left alone for another 100 s" in reasons(second)
    assert third.degraded == ()
    assert clock.waits == []
    assert len(server.requests) == 2


def test_backs_off_with_a_seed():
    waits: list[list[float]] = []
    for seed in (0, 0, 1):
        clock = Clock()
        plan_of(error(500), error(503), error(500), GOOD, clock=clock, seed=seed)
        waits.append(clock.waits)
    assert waits[0] == waits[1] != waits[2]
    assert all(0.5 * 2**i <= wait <= 2**i for i, wait in enumerate(waits[0]))


def test_a_server_that_fails_is_left_alone_and_tried_again_once():
    clock = Clock()
    with serving(*[error(500)] * 6, GOOD) as server:
        asked = planner(server, clock, retries=3, breaker_failures=5, breaker_rest_s=60)
        plans = [asked.plan(SCENE, ASK, Memory()) for _ in range(3)]
        assert len(server.requests) == 5
        clock.now += 61
        plans.append(asked.plan(SCENE, ASK, Memory()))
        assert len(server.requests) == 6
        clock.now += 61
        well = [asked.plan(SCENE, ASK, Memory()) for _ in range(2)]
        asked.close()
    assert all(is_fallback(p) for p in plans)
    assert [p.usage.requests for p in plans] == [4, 1, 0, 1]
    assert "4 requests failed, the last with: HTTP 500" in reasons(plans[0])
    assert "left alone for another 60 s" in reasons(plans[2])
    assert all(p.degraded == () for p in well)


def test_a_server_that_hangs_costs_its_timeout_once():
    plan, server = plan_of(Step(hang=True), request_timeout_s=0.15, retries=0)
    assert is_fallback(plan)
    assert "no reply within 0.15 s" in reasons(plan)
    assert len(server.requests) == 1


def test_a_decision_has_its_own_deadline():
    plan, server = plan_of(Step(hang=True), request_timeout_s=3, decision_timeout_s=0.15)
    assert is_fallback(plan)
    assert "no reply within 0.15 s" in reasons(plan)
    assert len(server.requests) <= 2


def test_a_body_that_trickles_in_costs_no_more_than_the_timeout():
    plan, _ = plan_of(replace(GOOD, drip_s=0.03), request_timeout_s=0.15, retries=0)
    assert is_fallback(plan)
    assert "no reply within 0.15 s" in reasons(plan)


def test_nobody_listens():
    plan = planner(dead_url(), retries=1).plan(SCENE, ASK, Memory())
    assert is_fallback(plan)
    assert "cannot be reached" in reasons(plan)
    assert plan.usage.requests == 2
    assert plan.usage.usd == 0


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (replace(GOOD, cut_at=40), "cannot be reached (RemoteProtocolError"),
        (Step(body=GOOD.body[: len(GOOD.body) // 2]), "not complete JSON"),
        (Step(body=b"<html>Sign in</html>", headers={"Content-Type": "text/html"}), "text/html"),
        (Step(body=b"[" * 100_000), "not complete JSON"),
        (Step(body=b"\xff\xfe\x00"), "not complete JSON"),
        (Step(body=b'{"choices": []}'), "no chat completion"),
        (Step(body=b'{"choices": [{"message": null}]}'), "no chat completion"),
        (Step(body=b'{"error": {"message": "overloaded"}}'), "overloaded"),
        (Step(body=b"null"), "no chat completion"),
    ],
    ids=["connection cut", "half", "html", "deep", "binary", "no choice", "no message", "error with 200", "null"],
)
def test_a_reply_that_is_none_is_asked_for_again(step, reason):
    plan, server = plan_of(step, GOOD)
    assert plan.mark == GREEN
    assert len(server.requests) == 2
    assert reason in reasons(plan)


def test_good_json_counts_whatever_it_is_called():
    plan, _ = plan_of(replace(GOOD, headers={"Content-Type": "text/plain"}))
    assert plan.degraded == ()


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (good("x" * 10_000_000), "longer than 1000000 bytes"),
        (Step(500, b"x" * 10_000_000), "longer than 1000000 bytes"),
        (replace(GOOD, headers={"Content-Encoding": "gzip"}), "compressed"),
        (good(None, refusal="I cannot help with that."), "the model refuses: I cannot help with that."),
        (error(401, "Incorrect API key"), "HTTP 401 Unauthorized: Incorrect API key"),
        (error(404, "no such model"), "HTTP 404 Not Found: no such model"),
        (error(429, "no credit", code="insufficient_quota"), "no credit"),
        (Step(302, b"", {"Location": "http://127.0.0.1:1/v1"}), "HTTP 302"),
    ],
    ids=["10 MB", "10 MB error", "gzip", "refusal", "key", "model", "credit", "redirect"],
)
def test_what_would_not_get_better_is_not_asked_again(step, reason):
    plan, server = plan_of(step)
    assert is_fallback(plan)
    assert reason in reasons(plan)
    assert len(server.requests) == 1


@pytest.mark.parametrize("status", [400, 422])
def test_the_reply_format_is_found_out_once(status):
    no = error(status, "response_format is not supported")
    with serving(no, no, GOOD) as server:
        asked = planner(server)
        first, second = (asked.plan(SCENE, ASK, Memory()) for _ in range(2))
        asked.close()
    formats = [r.body.get("response_format", {}).get("type", "text") for r in server.requests]
    assert formats == ["json_schema", "json_object", "text", "text"]
    assert "json schema" in server.requests[-1].text.lower()
    assert first.mark == second.mark == GREEN
    assert "refuses response_format json_schema" in reasons(first)
    assert "text replies from now on" in reasons(first)
    assert second.degraded == ()


def test_a_bad_request_leaves_the_format_unknown():
    with serving(*[error(400, "the image is too large")] * 3, GOOD) as server:
        asked = planner(server)
        first, second = (asked.plan(SCENE, ASK, Memory()) for _ in range(2))
        asked.close()
    assert is_fallback(first)
    assert "the image is too large" in reasons(first)
    assert second.degraded == ()
    assert server.requests[-1].body["response_format"]["type"] == "json_schema"


def test_models_without_temperature_are_asked_without_it():
    no = error(400, "Unsupported value: 'temperature' does not support 0 with this model.")
    with serving(no, GOOD) as server:
        asked = planner(server)
        plans = [asked.plan(SCENE, ASK, Memory()) for _ in range(2)]
        asked.close()
    assert ["temperature" in r.body for r in server.requests] == [True, False, False]
    assert all("response_format" in r.body for r in server.requests)
    assert "refuses temperature" in reasons(plans[0])
    assert plans[1].degraded == ()
