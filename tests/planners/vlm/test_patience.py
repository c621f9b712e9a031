"""Waits that servers ask for, and when a server is left alone."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from thinkgrasp.planners.vlm.patience import MAX_HOLD_S, Backoff, CircuitBreaker, retry_after_s

NOW = datetime(1994, 11, 6, 8, 49, 37, tzinfo=UTC)


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        ({}, None),
        ({"retry-after": "3"}, 3),
        ({"retry-after": "0.5"}, 0.5),
        ({"retry-after-ms": "250", "retry-after": "1"}, 0.25),
        ({"retry-after": "Sun, 06 Nov 1994 08:49:47 GMT"}, 10),
        ({"retry-after": "Sun, 06 Nov 1994 08:49:47 GMT", "date": "Sun, 06 Nov 1994 08:49:42 GMT"}, 5),
        ({"retry-after": "Sun, 06 Nov 1994 09:49:47 +0100"}, 10),
        ({"retry-after": "Sun, 06 Nov 1994 08:00:00 GMT"}, 0),
        ({"retry-after": "-1"}, None),
        ({"retry-after": "inf"}, None),
        ({"retry-after": "nan"}, None),
        ({"retry-after": "soon"}, None),
        ({"retry-after": "Sun, 99 Nov 1994 08:49:47 GMT"}, None),
        ({"retry-after": ""}, None),
    ],
)
def test_retry_after(headers, seconds):
    assert retry_after_s(headers, NOW) == seconds


def test_waits_double_up_to_a_limit():
    backoff = Backoff(first_s=1, most_s=8, seed=3)
    waits = [backoff.wait_s(n) for n in range(1, 8)]
    assert all(0.5 * min(2**i, 8) <= wait <= min(2**i, 8) for i, wait in enumerate(waits))
    again = Backoff(first_s=1, most_s=8, seed=3)
    assert waits == [again.wait_s(n) for n in range(1, 8)]


def test_a_breaker_opens_rests_and_tries_once():
    now = [0.0]
    breaker = CircuitBreaker(failures=2, rest_s=10, clock=lambda: now[0])
    breaker.failed()
    breaker.succeeded()
    breaker.failed()
    assert breaker.remaining_s() == 0
    breaker.failed()
    assert breaker.remaining_s() == 10
    now[0] = 10
    assert breaker.remaining_s() == 0
    breaker.failed()
    assert breaker.remaining_s() == 10
    now[0] = 20
    breaker.succeeded()
    breaker.failed()
    assert breaker.remaining_s() == 0


def test_no_server_can_ask_for_a_rest_without_end():
    breaker = CircuitBreaker(failures=2, rest_s=10, clock=lambda: 0.0)
    breaker.hold(1e12)
    assert breaker.remaining_s() == MAX_HOLD_S
