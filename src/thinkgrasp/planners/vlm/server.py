"""Asking one server with patience: retries, deadlines, a circuit breaker, and the reply format that it understands."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from thinkgrasp.planners.vlm.chat import FORMATS, Answer, Question, ReplyFormat, Unanswered
from thinkgrasp.planners.vlm.endpoint import Endpoint, Reply, RequestFailed
from thinkgrasp.planners.vlm.patience import Backoff, CircuitBreaker
from thinkgrasp.types import Degradation

REFUSED_REQUEST = frozenset({400, 415, 422, 501})
"""Statuses by which servers say that they do not know something in a request."""


@dataclass(frozen=True)
class Dialect:
    """What a server takes; the first guess is all of it."""

    reply_format: ReplyFormat = FORMATS[0]
    temperature: bool = True

    def plainer(self, failure: RequestFailed, question: Question) -> Dialect | None:
        """Return what to try after a refused request; None where nothing is left to leave out."""
        if failure.status not in REFUSED_REQUEST:
            return None
        if self.temperature and question.temperature is not None and "temperature" in failure.reason.lower():
            return replace(self, temperature=False)
        at = FORMATS.index(self.reply_format)
        if question.schema is None or at + 1 == len(FORMATS):
            return None
        return replace(self, reply_format=FORMATS[at + 1])

    def left_out(self, plainer: Dialect) -> tuple[str, str]:
        """Return what a plainer dialect does without, and what it does instead."""
        if self.temperature and not plainer.temperature:
            return "temperature", "the server's own temperature"
        return f"response_format {self.reply_format}", f"{plainer.reply_format.replace('_', ' ')} replies from now on"


class ChatServer:
    """A server that is asked until it answers, a limit is reached, or it is known to be down.

    Args:
        endpoint: Sends one request.
        request_timeout_s: For each request; a decision's deadline can make it shorter.
        retries: How often a failed request is sent again for one question.
        backoff: Waits between them where the server names none.
        breaker: Keeps count of failures over all questions.
        clock: Monotonic [s].
        sleep: Waits [s].
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        request_timeout_s: float,
        retries: int,
        backoff: Backoff,
        breaker: CircuitBreaker,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.dialect = Dialect()
        self._endpoint = endpoint
        self._request_timeout_s = request_timeout_s
        self._retries = retries
        self._backoff = backoff
        self._breaker = breaker
        self._clock = clock
        self._sleep = sleep

    def close(self) -> None:
        """Close the connections."""
        self._endpoint.close()

    def ask(self, question: Question, deadline: float) -> Answer:
        """Return the server's answer.

        Args:
            question: What to ask.
            deadline: When to give up, on the clock [s].

        Raises:
            Unanswered: It does not answer in time, or not at all, or is being left alone after failures.
        """
        started = self._clock()
        resting_s = self._breaker.remaining_s()
        if resting_s > 0:
            raise Unanswered(f"the server failed before and is left alone for another {resting_s:.0f} s")
        dialect, requests, failures = self.dialect, 0, list[RequestFailed]()
        notes: list[Degradation] = []
        while True:
            left_s = deadline - self._clock()
            if left_s <= 0:
                raise self._unanswered("the time for this decision is over", failures, requests, started)
            body = question.body(dialect.reply_format, with_temperature=dialect.temperature)
            requests += 1
            try:
                reply = self._endpoint.post(body, min(self._request_timeout_s, left_s))
                break
            except RequestFailed as failure:
                plainer = dialect.plainer(failure, question)
                if plainer is not None:
                    what, instead = dialect.left_out(plainer)
                    notes.append(Degradation("plan", f"the server refuses {what} ({failure.reason})", instead))
                    dialect = plainer
                    continue
                failures.append(failure)
                self._breaker.failed()
                self._pause(failure, failures, requests, started, deadline)
        self._breaker.succeeded()
        self.dialect = dialect
        if failures:
            notes.append(Degradation("plan", _told(failures), "asked again"))
        return _answer(reply, question, requests, self._clock() - started, notes)

    def _pause(
        self, failure: RequestFailed, failures: list[RequestFailed], requests: int, started: float, deadline: float
    ) -> None:
        """Wait before the next request, or raise Unanswered where there is to be none."""
        if not failure.transient or len(failures) > self._retries or self._breaker.remaining_s() > 0:
            raise self._unanswered("", failures, requests, started)
        wait_s = self._backoff.wait_s(len(failures)) if failure.wait_s is None else failure.wait_s
        if self._clock() + wait_s >= deadline:
            if failure.wait_s is not None:
                self._breaker.hold(wait_s)
            why = f"waiting {wait_s:.3g} s for the next request would exceed the time for this decision"
            raise self._unanswered(why, failures, requests, started)
        self._sleep(wait_s)

    def _unanswered(self, why: str, failures: list[RequestFailed], requests: int, started: float) -> Unanswered:
        reason = "; ".join(part for part in (_told(failures), why) if part)
        return Unanswered(reason, requests=requests, latency_s=self._clock() - started)


def _told(failures: list[RequestFailed]) -> str:
    if len(failures) < 2:
        return failures[0].reason if failures else ""
    return f"{len(failures)} requests failed, the last with: {failures[-1].reason}"


def _answer(reply: Reply, question: Question, requests: int, latency_s: float, notes: list[Degradation]) -> Answer:
    return Answer(
        text=reply.text,
        model=reply.model or question.model,
        prompt_tokens=reply.prompt_tokens,
        completion_tokens=reply.completion_tokens,
        refusal=reply.refusal,
        requests=requests,
        latency_s=latency_s,
        notes=tuple(notes),
    )
