"""A recorder that says each step in one line."""

from __future__ import annotations

from collections.abc import Callable

from thinkgrasp.types import Decision, Outcome


class Teller:
    """Says every finished step in one line."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._step = 0

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        self._step += 1
        plan = decision.plan
        what = f"{plan.target} ({plan.role})" if plan.found else "nothing"
        result = "not executed: " + decision.status.replace("_", " ") if outcome is None else outcome.reason
        self._tell(f"step {self._step}: {what}: {result.replace('_', ' ')}")
