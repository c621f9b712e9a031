"""The closed loop over HTTP: what `thinkgrasp.loop.run_episode` keeps between its steps, kept between requests.

A client sends a frame (observe), carries the grasp out, and says what became of it (outcome). Episodes live in the
server's own process; the workers that decide keep nothing of them.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from thinkgrasp.loop import End
from thinkgrasp.memory import Memory
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.decoding import FrameUpload
from thinkgrasp.server.jobs import STILL_THERE, Decide, Decided, Settings, Sighting, with_last_outcome
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.problems import RequestProblem
from thinkgrasp.server.schema import EpisodeAnswer
from thinkgrasp.types import Outcome, Usage

State = Literal["observe", "act", "ended"]


@dataclass
class Episode:
    """One episode; its fields change with every request."""

    id: str
    instruction: str
    step_limit: int
    state: State = "observe"
    end: End | None = None
    attempts: int = 0
    memory: Memory = field(default_factory=Memory)
    usage: Usage = field(default_factory=Usage)
    touched: float = 0.0
    is_busy: bool = False
    _pending: Decided | None = None
    """The decision whose outcome is awaited."""
    _removed: Sighting | None = None
    """What was said to be removed, and not seen to be gone yet."""

    @contextmanager
    def turn(self, *states: State) -> Iterator[None]:
        """Hold the episode for one request.

        Raises:
            RequestProblem: 409; another request holds it, or it waits for something else.
        """
        if self.is_busy:
            raise RequestProblem(409, "episode_busy", "another request of this episode is being answered")
        if self.state not in states:
            wanted = {
                "observe": "it waits for a frame: POST .../observe",
                "act": "it waits for the outcome of the grasp: POST .../outcome",
                "ended": f"it has ended: {self.end}",
            }[self.state]
            raise RequestProblem(409, "wrong_turn", f"this episode does not take that now; {wanted}")
        self.is_busy = True
        try:
            yield
        finally:
            self.is_busy = False

    def observe(self, frame: FrameUpload, settings: Settings, *, more_views: bool, budget_usd: float | None) -> Decide:
        """Return the job that decides on a frame.

        Args:
            frame: What the camera sees now.
            settings: Of the client.
            more_views: Another view of the same scene follows.
            budget_usd: What the planner may spend in one episode; None = no limit.
        """
        left = budget_usd
        if budget_usd is not None:
            unknown = self.usage.requests > 0 and self.usage.usd is None
            left = 0.0 if unknown else budget_usd - (self.usage.usd or 0.0)
        return Decide(
            frame, self.instruction, settings, self.memory, self._removed, more_views=more_views, budget_usd=left
        )

    def observed(self, answer: Decided, *, more_views: bool) -> None:
        """Take note of a decision; one that was stopped meanwhile stays so."""
        if self.state == "ended":
            return
        self.usage += answer.usage
        self._removed = None
        self.memory = answer.memory or self.memory
        if answer.attempted is not None:
            self.state, self._pending = "act", answer
        elif answer.out_of_budget:
            self._finish("budget_spent")
        elif not more_views:
            self._finish("nothing_left" if answer.decision.status == "no_target" else "no_grasp")

    @property
    def awaited(self) -> DecisionModel | None:
        """The decision whose outcome is to come."""
        return None if self._pending is None else self._pending.decision

    @property
    def awaits_removal(self) -> Sighting | None:
        """What is to be gone if the grasp that is carried out now succeeds."""
        return None if self._pending is None else self._pending.sighting

    def acted(self, outcome: Outcome, *, delivered: bool | None, is_verified: bool | None) -> None:
        """Take note of what became of the grasp.

        Args:
            outcome: As the client reports it.
            delivered: Whether the goal lies in the bin; None: a success at the goal counts.
            is_verified: Whether a frame shows that the target is gone; False overrules a success; None = not seen yet.
        """
        pending = self._pending
        if pending is None or pending.attempted is None:
            raise RequestProblem(409, "wrong_turn", "this episode does not wait for an outcome")
        if outcome.success and is_verified is False:
            outcome = STILL_THERE
        self.memory = with_last_outcome(pending.attempted, outcome)
        self.attempts += 1
        self._pending = None
        self._removed = pending.sighting if outcome.success and is_verified is None else None
        is_goal = pending.decision.plan.role == "goal" if delivered is None else delivered
        if outcome.success and is_goal:
            self._finish("goal_delivered")
        elif self.attempts >= self.step_limit:
            self._finish("step_limit")
        else:
            self.state = "observe"

    def stop(self) -> None:
        """End it, whatever it waits for."""
        if self.state != "ended":
            self._finish("stopped")

    def answer(
        self,
        limits: Limits,
        *,
        decision: DecisionModel | None = None,
        undone: bool = False,
        verified: bool | None = None,
    ) -> EpisodeAnswer:
        """Return where it stands in its published form."""
        return EpisodeAnswer(
            episode=self.id,
            state=self.state,
            end=self.end,
            success=self.end == "goal_delivered",
            instruction=self.instruction,
            attempts=self.attempts,
            step_limit=self.step_limit,
            expires_s=limits.episode_ttl_s,
            undone=undone,
            verified=verified,
            decision=decision,
        )

    def _finish(self, end: End) -> None:
        self.state, self.end, self._pending, self._removed = "ended", end, None, None
        self.memory = Memory()


class Episodes:
    """All open episodes.

    Args:
        limits: How many, and for how long without a request.
        clock: Monotonic [s].
    """

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits = limits
        self._clock = clock
        self._open: dict[str, Episode] = {}

    def __len__(self) -> int:
        self._sweep()
        return len(self._open)

    def create(self, instruction: str, step_limit: int) -> Episode:
        """Open one.

        Raises:
            RequestProblem: 429; too many are open.
        """
        self._sweep()
        if len(self._open) >= self._limits.episodes:
            oldest = min(e.touched for e in self._open.values())
            wait = math.ceil(max(1.0, oldest + self._limits.episode_ttl_s - self._clock()))
            said = f"{len(self._open)} episodes are open, which is all that are allowed; end one by DELETE"
            raise RequestProblem(429, "too_many_episodes", said, {"Retry-After": str(min(wait, 60))})
        episode = Episode(secrets.token_urlsafe(16), instruction, step_limit, touched=self._clock())
        self._open[episode.id] = episode
        return episode

    def get(self, episode_id: str) -> Episode:
        """Return one, and let it live on.

        Raises:
            RequestProblem: 404; there is none with this id, or it has expired.
        """
        self._sweep()
        episode = self._open.get(episode_id)
        if episode is None:
            said = f"no episode has this id; after {self._limits.episode_ttl_s:g} s without a request one is forgotten"
            raise RequestProblem(404, "no_such_episode", said)
        episode.touched = self._clock()
        return episode

    @contextmanager
    def turn(self, episode_id: str, *states: State) -> Iterator[Episode]:
        """Hold one for one request, from whose end on it lives on; raises as `get` and as `Episode.turn`."""
        episode = self.get(episode_id)
        with episode.turn(*states):
            try:
                yield episode
            finally:
                episode.touched = self._clock()

    def remove(self, episode_id: str) -> Episode:
        """End one and forget it; raises as `get`."""
        episode = self.get(episode_id)
        episode.stop()
        del self._open[episode_id]
        return episode

    def _sweep(self) -> None:
        oldest = self._clock() - self._limits.episode_ttl_s
        for episode in [e for e in self._open.values() if e.touched < oldest and not e.is_busy]:
            del self._open[episode.id]
