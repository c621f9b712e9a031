"""What a server counts, in Prometheus' text format; one registry per app."""

from __future__ import annotations

import os
from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.jobs import Decided
from thinkgrasp.server.pool import Pool
from thinkgrasp.server.workers import resident_bytes

CONTENT_TYPE = CONTENT_TYPE_LATEST
SECONDS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1, 1.5, 2, 3, 5, 7.5, 10, 15, 30, 60, 120)
METHODS = ("GET", "POST", "DELETE", "HEAD", "OPTIONS", "PUT", "PATCH")


class Metrics:
    """The counters of one server."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self._requests = Counter(
            "thinkgrasp_http_requests", "Requests answered", ["route", "method", "status"], registry=registry
        )
        self._seconds = Histogram(
            "thinkgrasp_http_request_seconds", "Time to an answer", ["route"], buckets=SECONDS, registry=registry
        )
        self._stages = Histogram(
            "thinkgrasp_stage_seconds", "Time in a stage", ["stage"], buckets=SECONDS, registry=registry
        )
        self._decisions = Counter("thinkgrasp_decisions", "Decisions by status", ["status"], registry=registry)
        self._degraded = Counter("thinkgrasp_degraded", "Fallbacks taken by stage", ["stage"], registry=registry)
        self._tokens = Counter("thinkgrasp_model_tokens", "Tokens of the planner's model", ["kind"], registry=registry)
        self._asked = Counter("thinkgrasp_model_requests", "Requests to the planner's model", registry=registry)
        self._usd = Counter("thinkgrasp_model_usd", "Known cost of the planner's model", registry=registry)
        self._restarts = Counter("thinkgrasp_worker_restarts", "Workers started anew", ["reason"], registry=registry)
        self._cancelled = Counter("thinkgrasp_cancelled", "Requests whose client left", registry=registry)

    def watch(self, pool: Pool, episodes: Callable[[], int]) -> None:
        """Also report the state of a pool and how many episodes are open."""
        for name, text, value in (
            ("thinkgrasp_workers_ready", "Workers with their models loaded", lambda: pool.ready),
            ("thinkgrasp_requests_running", "Requests that have a worker or wait for one", lambda: pool.admitted),
            ("thinkgrasp_requests_waiting", "Requests that wait for a worker", lambda: pool.waiting),
            ("thinkgrasp_episodes_open", "Open episodes", episodes),
            ("thinkgrasp_resident_bytes", "Memory of the server's own process", lambda: resident_bytes(os.getpid())),
        ):
            Gauge(name, text, registry=self.registry).set_function(value)
        memory = Gauge("thinkgrasp_worker_resident_bytes", "Memory of a worker", ["worker"], registry=self.registry)
        for number, worker in enumerate(pool.workers):
            memory.labels(str(number)).set_function(worker.memory_bytes)

    def answered(self, route: str, method: str, status: int, seconds: float) -> None:
        """Count an answer."""
        self._requests.labels(route, method if method in METHODS else "other", str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def stage(self, stage: str, seconds: float) -> None:
        """Count a stage's time."""
        self._stages.labels(stage).observe(seconds)

    def decided(self, answer: Decided) -> None:
        """Count a decision, its fallbacks and its cost."""
        model: DecisionModel = answer.decision
        self._decisions.labels(model.status).inc()
        for note in model.degraded:
            self._degraded.labels(note.stage).inc()
        usage = answer.usage
        self._asked.inc(usage.requests)
        self._tokens.labels("prompt").inc(usage.prompt_tokens)
        self._tokens.labels("completion").inc(usage.completion_tokens)
        self._usd.inc(usage.usd or 0.0)

    def restarted(self, reason: str) -> None:
        """Count a worker that is started anew."""
        self._restarts.labels(reason).inc()

    def cancelled(self) -> None:
        """Count a request whose client left."""
        self._cancelled.inc()

    def text(self) -> bytes:
        """Return everything in Prometheus' text format."""
        return generate_latest(self.registry)
