from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from thinkgrasp.benchmark.statistics import (
    holm,
    mcnemar,
    mean_interval,
    paired_difference,
    ratio_interval,
    signs_test,
    wilson,
)


def test_wilson_by_the_closed_formula():
    assert wilson(87, 100) == pytest.approx((0.7902, 0.9224), abs=1e-4)
    assert wilson(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


@given(st.integers(0, 200), st.integers(1, 200))
@settings(max_examples=50, deadline=None)
def test_wilson_holds_the_rate(k, n):
    k = min(k, n)
    low, high = wilson(k, n)
    assert low - 1e-12 <= k / n <= high + 1e-12
    assert (low, high) == pytest.approx((1 - wilson(n - k, n).high, 1 - wilson(n - k, n).low), abs=1e-12)


def test_paired_difference_is_newcombes():
    """His published example."""
    assert paired_difference(36, 12, 2, 0) == pytest.approx((0.0569, 0.3404), abs=1e-4)
    assert paired_difference(0, 0, 0, 0) == (-1.0, 1.0)


@given(*[st.integers(0, 60)] * 4)
@settings(max_examples=60, deadline=None)
def test_paired_difference_holds_the_difference(both, won, lost, neither):
    n = both + won + lost + neither
    low, high = paired_difference(both, won, lost, neither)
    assert -1 - 1e-9 <= low <= high <= 1 + 1e-9
    if n:
        assert low - 1e-9 <= (won - lost) / n <= high + 1e-9
    mirrored = paired_difference(both, lost, won, neither)
    assert (low, high) == pytest.approx((-mirrored.high, -mirrored.low), abs=1e-9)


@pytest.mark.parametrize(("won", "lost", "p"), [(0, 0, 1.0), (5, 0, 2 / 32), (6, 1, 2 * 8 / 128), (4, 4, 1.0)])
def test_mcnemar_by_hand(won, lost, p):
    assert mcnemar(won, lost) == pytest.approx(p)
    assert mcnemar(lost, won) == pytest.approx(p)


@given(st.lists(st.integers(-6, 6), max_size=9))
@settings(max_examples=60, deadline=None)
def test_signs_test_counts_every_assignment(differences):
    sums = [sum(s * abs(d) for s, d in zip(signs, differences, strict=True)) for signs in
            itertools.product((-1, 1), repeat=len(differences))]  # fmt: skip
    expected = np.mean([abs(s) >= abs(sum(differences)) for s in sums])
    assert signs_test(differences) == pytest.approx(expected)
    assert signs_test([*differences, 0, 0]) == pytest.approx(expected)
    assert signs_test([-d for d in differences]) == pytest.approx(expected)


def test_signs_test_of_ones_is_the_sign_test():
    assert signs_test([1] * 9 + [-1] * 2) == pytest.approx(binomtest(9, 11).pvalue)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx((0.03, 0.06, 0.06))
    assert holm([0.6, 0.5]) == (1.0, 1.0)
    assert holm([]) == ()


@given(st.lists(st.floats(0, 1), max_size=8))
@settings(max_examples=40, deadline=None)
def test_holm_only_raises_and_keeps_the_order(p_values):
    adjusted = holm(p_values)
    assert all(p <= q <= 1 for p, q in zip(p_values, adjusted, strict=True))
    ranked = sorted(range(len(p_values)), key=lambda i: p_values[i])
    assert list(np.diff([adjusted[i] for i in ranked]) >= 0) == [True] * max(0, len(p_values) - 1)


def test_mean_interval_covers_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(120):
        found = mean_interval({task: rng.normal(center, 1.0, 15).tolist() for task, center in (("a", 1), ("b", 5))})
        assert found is not None
        covered += found.low <= 3 <= found.high
    assert 104 <= covered <= 120


def test_intervals_do_not_depend_on_order():
    values = {"a": [1.0, 2.0, 5.0, 3.0], "b": [2.0, 9.0]}
    turned = {"b": [9.0, 2.0], "a": [5.0, 3.0, 1.0, 2.0], "c": []}
    assert mean_interval(values) == mean_interval(turned)
    pairs = {"a": [(1.0, 2.0), (0.0, 3.0), (2.0, 2.0)], "b": [(1.0, 1.0)]}
    assert ratio_interval(pairs) == ratio_interval({"b": [(1.0, 1.0), (0.0, 0.0)], "a": pairs["a"][::-1]})


def test_no_interval_of_what_does_not_vary():
    assert mean_interval({"a": [1.0, 1.0], "b": [2.0]}) is None
    assert mean_interval({}) is None
    assert ratio_interval({"a": [(1.0, 2.0)]}) is None


def test_ratio_interval_is_wider_where_steps_belong_together():
    """Ten right and ten wrong steps: as twenty episodes of one step, and as two of ten."""
    apart = ratio_interval({"a": [(1.0, 1.0)] * 10 + [(0.0, 1.0)] * 10})
    together = ratio_interval({"a": [(10.0, 10.0), (0.0, 10.0)]})
    assert apart is not None
    assert together is not None
    assert together.high - together.low > 2 * (apart.high - apart.low)
