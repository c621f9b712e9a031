"""The planner of a model asked through OpenAI's interface: a fake server, and time that passes in waits alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fakes.chat_server import ChatServer, Step, good, serving

from thinkgrasp.memory import Memory
from thinkgrasp.planners.openai_compatible import OpenAIPlanner
from thinkgrasp.testing import sample_scene
from thinkgrasp.types import Plan

KEY = "canary-8d1f0c4b5e"
SCENE = sample_scene()
GREEN = 5
REPLY = {
    "rationale": "it is green",
    "visible": True,
    "target": "green thing",
    "mark": GREEN,
    "role": "goal",
    "kind": "object",
    "cell": 4,
    "objects": [{"name": "green thing", "mark": GREEN, "grasp_score": 80, "cell": 4}],
}
GOOD = good(REPLY)
WRONG_MARK = good(REPLY | {"mark": 99})
ASK = "the green thing"


class Clock:
    """Time that passes only in waits."""

    def __init__(self) -> None:
        self.now = 0.0
        self.waits: list[float] = []

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.now += seconds


def planner(server: ChatServer | str, clock: Clock | None = None, **settings: Any) -> OpenAIPlanner:
    clock = clock or Clock()
    url = server if isinstance(server, str) else server.url
    settings = {"base_url": url, "key_env": "TEST_KEY", "request_timeout_s": 5} | settings
    return OpenAIPlanner(clock=clock, sleep=clock.sleep, **settings)


def plan_of(*steps: Step, **settings: Any) -> tuple[Plan, ChatServer]:
    with serving(*steps) as server:
        asked = planner(server, **settings)
        plan = asked.plan(SCENE, ASK, Memory())
        asked.close()
    return plan, server


def reasons(plan: Plan) -> str:
    return "; ".join(f"{d.reason} -> {d.fallback}" for d in plan.degraded)


def is_fallback(plan: Plan) -> bool:
    return any(d.fallback == "the offline planner" for d in plan.degraded) and plan.mark == GREEN and plan.found


def recorded(path: Path) -> Path:
    with serving(GOOD) as server:
        asked = planner(server, record=path)
        asked.plan(SCENE, ASK, Memory())
        asked.close()
    return path
