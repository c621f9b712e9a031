"""What may be said of rates, means and differences that were seen in few episodes.

Nothing depends on the order of what is given: values are sorted before they are resampled, with a fixed seed.

References:
    [Wilson1927] J. Am. Stat. Assoc. 22, 209: the score interval; [Newcombe1998] Stat. Med. 17, 2635, method 10;
    [McNemar1947] Psychometrika 12, 153, in its exact form; [Pitman1937] J. R. Stat. Soc. Suppl. 4, 119: the test of
    paired differences by their signs; [Holm1979] Scand. J. Stat. 6, 65; [Efron1993] An Introduction to the Bootstrap,
    chapter 13: percentile intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

LEVEL = 0.95
RESAMPLES = 4000
_SEED = 20240716


class Interval(NamedTuple):
    """A 95 % confidence interval."""

    low: float
    high: float


def wilson(k: int, n: int) -> Interval:
    """Return the interval of a rate of which k of n independent trials succeeded; 0 to 1 where n = 0 [Wilson1927]."""
    if n == 0:
        return Interval(0.0, 1.0)
    found = binomtest(k, n).proportion_ci(LEVEL, method="wilson")
    return Interval(float(found.low), float(found.high))


def paired_difference(both: int, won: int, lost: int, neither: int) -> Interval:
    """Return the interval of the difference of two rates that were seen on the same piles [Newcombe1998]."""
    n = both + won + lost + neither
    if n == 0:
        return Interval(-1.0, 1.0)
    p, q = (both + won) / n, (both + lost) / n
    (p_low, p_high), (q_low, q_high) = wilson(both + won, n), wilson(both + lost, n)
    margins = (both + won) * (lost + neither) * (both + lost) * (won + neither)
    excess = both * neither - won * lost
    corrected = max(excess - n / 2, 0.0) if excess > 0 else float(excess)
    correlation = corrected / math.sqrt(margins) if margins else 0.0

    def reach(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * correlation * a * b + b * b))

    return Interval(p - q - reach(p - p_low, q_high - q), p - q + reach(p_high - p, q - q_low))


def mcnemar(won: int, lost: int) -> float:
    """Return the exact two-sided p-value of as many pairs won as lost; ties say nothing [McNemar1947]."""
    return 1.0 if won + lost == 0 else float(binomtest(won, won + lost).pvalue)


def signs_test(differences: Sequence[int]) -> float:
    """Return the exact two-sided p-value of paired differences that are as often of either sign.

    Every assignment of signs is as likely as the one that was seen; the p-value is the share of those whose sum is at
    least as far from zero. Counted by convolution over the integers, so that nothing is drawn and no normal law is
    asked for; zeros change no sum [Pitman1937].
    """
    sizes = [abs(d) for d in differences if d]
    total, reach = abs(sum(differences)), sum(sizes)
    ways = np.zeros(2 * reach + 1)
    ways[reach] = 1.0
    for size in sizes:
        ways = (np.roll(ways, size) + np.roll(ways, -size)) / 2
    sums = np.abs(np.arange(-reach, reach + 1))
    return float(min(1.0, ways[sums >= total].sum()))


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Return p-values of several tests, adjusted so that any false alarm stays as rare as one [Holm1979]."""
    adjusted = [1.0] * len(p_values)
    highest = 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        highest = max(highest, min(1.0, p_values[i] * (len(p_values) - rank)))
        adjusted[i] = highest
    return tuple(adjusted)


def mean_interval(strata: Mapping[str, Sequence[float]]) -> Interval | None:
    """Return the interval of the mean over strata of their means; each stratum is resampled by itself [Efron1993].

    Args:
        strata: Values by task; empty ones are left out.

    Returns:
        None where no two values of a stratum differ: resampling them would feign certainty.
    """
    chosen = [np.sort(np.asarray(values, float)) for _, values in sorted(strata.items()) if len(values)]
    if all(values[0] == values[-1] for values in chosen):
        return None
    rng = np.random.default_rng(_SEED)
    means = [v[rng.integers(len(v), size=(RESAMPLES, len(v)))].mean(axis=1) for v in chosen]
    return _percentiles(np.mean(means, axis=0))


def ratio_interval(strata: Mapping[str, Sequence[tuple[float, float]]]) -> Interval | None:
    """Return the interval of a sum over a sum; whole clusters are resampled, within their strata [Efron1993].

    Steps of one episode share a pile and its mistakes, so that they are no independent trials; episodes are.

    Args:
        strata: By task, of every episode a numerator and a denominator.

    Returns:
        None where there are fewer than two episodes with a denominator.
    """
    chosen = [
        np.asarray(sorted(pair for pair in pairs if pair[1]), float)
        for _, pairs in sorted(strata.items())
        if any(pair[1] for pair in pairs)
    ]
    if sum(map(len, chosen)) < 2:
        return None
    rng = np.random.default_rng(_SEED)
    sums = sum(v[rng.integers(len(v), size=(RESAMPLES, len(v)))].sum(axis=1) for v in chosen)
    return _percentiles(sums[:, 0] / sums[:, 1])  # pyright: ignore


def _percentiles(values: np.ndarray) -> Interval:
    low, high = np.quantile(values, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(float(low), float(high))
