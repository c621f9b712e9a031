"""How long to wait for a server that does not answer, and when to stop asking it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

import numpy as np

MAX_HOLD_S = 600.0
"""A server that asks for a longer rest is tried again after this."""


class Backoff:
    """Waits that double, each shortened by a random part so that many clients do not come back at once.

    Args:
        first_s: Longest first wait.
        most_s: Longest of all waits.
        seed: Of the random part.
    """

    def __init__(self, *, first_s: float = 1.0, most_s: float = 20.0, seed: int = 0) -> None:
        self.first_s = first_s
        self.most_s = most_s
        self._rng = np.random.default_rng(seed)

    def wait_s(self, failures: int) -> float:
        """Return the wait after so many failures in a row (1, 2, ...) [s]."""
        longest = min(self.first_s * 2.0 ** (failures - 1), self.most_s)
        return longest * float(self._rng.uniform(0.5, 1.0))


class CircuitBreaker:
    """Stops asking a server that failed often enough, and tries it again with one request after a rest.

    Args:
        failures: So many in a row open it.
        rest_s: How long it stays open.
        clock: Monotonic [s].
    """

    def __init__(self, *, failures: int, rest_s: float, clock: Callable[[], float]) -> None:
        self.failures = failures
        self.rest_s = rest_s
        self._clock = clock
        self._in_a_row = 0
        self._closed_from = -math.inf

    def remaining_s(self) -> float:
        """Return how long the server is still left alone; 0 = it may be asked."""
        return max(self._closed_from - self._clock(), 0.0)

    def succeeded(self) -> None:
        """Note that the server answered."""
        self._in_a_row = 0

    def failed(self) -> None:
        """Note that it did not; a failed try after a rest starts the next rest at once."""
        self._in_a_row += 1
        if self._in_a_row >= self.failures:
            self.hold(self.rest_s)

    def hold(self, seconds: float) -> None:
        """Leave the server alone for a time [s], at most MAX_HOLD_S."""
        self._closed_from = max(self._closed_from, self._clock() + min(seconds, MAX_HOLD_S))


def retry_after_s(headers: Mapping[str, str], now: datetime | None = None) -> float | None:
    """Return how long a reply's headers ask to wait [s]; None where they do not say, or not readably.

    Args:
        headers: With lower-case names.
        now: What an HTTP date counts from where the reply carries no Date of its own; None = the clock.
    """
    milliseconds = _seconds(headers.get("retry-after-ms"))
    if milliseconds is not None:
        return milliseconds / 1e3
    value = headers.get("retry-after")
    seconds = _seconds(value)
    if seconds is not None or value is None:
        return seconds
    until = _date(value)
    if until is None:
        return None
    since = _date(headers.get("date", "")) or now or datetime.now(UTC)
    return max((until - since).total_seconds(), 0.0)


def _seconds(value: str | None) -> float | None:
    try:
        seconds = float(value) if value is not None else math.nan
    except ValueError:
        return None
    return seconds if math.isfinite(seconds) and seconds >= 0 else None


def _date(value: str) -> datetime | None:
    try:
        date = parsedate_to_datetime(value)
    except (ValueError, TypeError):
        return None
    return date if date.tzinfo is not None else date.replace(tzinfo=UTC)
