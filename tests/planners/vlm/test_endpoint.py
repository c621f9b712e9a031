"""Where the key comes from, and that it is nowhere else."""

from __future__ import annotations

import json
import logging

import pytest
from fakes.chat_server import Step, dead_url, error, good, serving
from fakes.openai_planner import ASK, GOOD, GREEN, KEY, REPLY, SCENE, plan_of, planner

from thinkgrasp.memory import Memory

pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")


def test_a_local_server_is_asked_without_a_key(monkeypatch):
    for name in ("OPENAI_API_KEY", "OPENAI_ADMIN_KEY", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):
        monkeypatch.setenv(name, KEY)
    plan, server = plan_of(GOOD, key_env=None)
    assert plan.mark == GREEN
    assert KEY not in json.dumps(server.requests[0].headers)


def test_a_key_comes_from_a_file(tmp_path):
    path = tmp_path / "key"
    path.write_text("another-key\n")
    _, server = plan_of(GOOD, key_file=path)
    assert server.requests[0].headers["authorization"] == "Bearer another-key"


def test_the_key_is_nowhere(tmp_path, caplog, capsys):
    """Faults of every kind, by servers that repeat the key, with all loggers at their loudest."""
    caplog.set_level(logging.DEBUG)
    echo = f"Incorrect API key provided: {KEY}"
    steps = [
        error(401, echo),
        error(500, echo),
        error(429, echo, code="insufficient_quota"),
        good(REPLY | {"target": KEY, "rationale": echo}),
        good(None, refusal=echo),
        good(echo),
        good(REPLY, model=KEY),
        Step(body=echo.encode()),
        Step(302, b"", {"Location": "http://127.0.0.1:1/v1"}),
        Step(hang=True),
        Step(body=json.dumps({"error": echo}).encode()),
    ]
    shown: list[str] = []
    for i, step in enumerate(steps):
        for fallback in (True, False):
            with serving(step) as server:
                path = tmp_path / f"{i}.jsonl"
                asked = planner(server, retries=0, fallback=fallback, record=path, request_timeout_s=0.3)
                plan = asked.plan(SCENE, ASK, Memory())
                shown += [repr(plan), repr(asked), str(asked), repr(vars(asked)), path.read_text()]
                shown += [repr(vars(o)) for o in vars(asked).values() if hasattr(o, "__dict__")]
                asked.close()
    dead = planner(dead_url(), retries=0)
    shown += [repr(dead.plan(SCENE, ASK, Memory())), caplog.text, *capsys.readouterr()]
    assert len(caplog.text) > 1000
    assert all(KEY not in text for text in shown)
    assert "[key]" in "".join(shown)
