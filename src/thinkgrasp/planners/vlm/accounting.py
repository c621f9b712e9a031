"""What asking a model costs: tokens, requests, seconds and dollars; an unknown price stays unknown."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import cast

from thinkgrasp.errors import ConfigError
from thinkgrasp.planners.vlm.chat import Answer
from thinkgrasp.types import Usage

_VERSION = re.compile(r"-(?:\d{4}-\d{2}-\d{2}|latest)$")


@dataclass(frozen=True)
class Price:
    """US dollars per million tokens."""

    input: float
    output: float

    def usd(self, answer: Answer) -> float | None:
        """Return what an answer cost; None where the server did not count its tokens."""
        if answer.prompt_tokens is None or answer.completion_tokens is None:
            return None
        return (answer.prompt_tokens * self.input + answer.completion_tokens * self.output) / 1e6


@dataclass(frozen=True)
class Spending:
    """Sums over questions. Failed requests count as requests and as no tokens, as no server reports theirs."""

    requests: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    usd: float | None = 0.0
    """None from the first answer on whose cost is unknown."""
    latency_s: float = 0.0

    @classmethod
    def of(cls, answer: Answer, price: Price | None) -> Spending:
        """Return what one answer took."""
        return cls(
            answer.requests,
            answer.prompt_tokens or 0,
            answer.completion_tokens or 0,
            price.usd(answer) if price is not None else None,
            answer.latency_s,
        )

    def __add__(self, other: Spending) -> Spending:
        return Spending(
            self.requests + other.requests,
            self.prompt_tokens + other.prompt_tokens,
            self.completion_tokens + other.completion_tokens,
            self.usd + other.usd if self.usd is not None and other.usd is not None else None,
            self.latency_s + other.latency_s,
        )

    def usage(self, model: str) -> Usage:
        """Return it as a plan's usage."""
        return Usage(model, self.prompt_tokens, self.completion_tokens, self.usd, self.requests, self.latency_s)


class PriceList:
    """Prices by model; a model's dated versions (-2024-08-06, -latest) cost what the model costs unless listed."""

    def __init__(self, prices: Mapping[str, Price]) -> None:
        self._prices = dict(prices)

    @classmethod
    def load(cls, override: str | Path | Mapping[str, object] | None = None) -> PriceList:
        """Return the built-in prices, and over them those of a TOML file or a mapping of the same form.

        Raises:
            ConfigError: The file cannot be read, or an entry is not {input, output} in dollars per million tokens.
        """
        prices = dict(_built_in())
        if isinstance(override, Mapping):
            prices |= _read(override, "prices")
        elif override is not None:
            try:
                text = Path(override).read_text(encoding="utf-8")
                prices |= _read(tomllib.loads(text), f"prices file {override}")
            except (OSError, ValueError) as error:
                raise ConfigError(f"openai planner: prices file {override} cannot be read: {error}") from error
        return cls(prices)

    def of(self, model: str) -> Price | None:
        """Return a model's price; None where it is not known."""
        return self._prices.get(model) or self._prices.get(_VERSION.sub("", model))


@cache
def _built_in() -> Mapping[str, Price]:
    text = resources.files(__package__ or "").joinpath("prices.toml").read_text(encoding="utf-8")
    return _read(tomllib.loads(text), "prices.toml")


def _read(entries: Mapping[str, object], where: str) -> dict[str, Price]:
    prices: dict[str, Price] = {}
    for model, entry in entries.items():
        values = cast(Mapping[str, object], entry) if isinstance(entry, Mapping) else {}
        if set(values) != {"input", "output"} or not all(_is_price(v) for v in values.values()):
            raise ConfigError(
                f"openai planner: {where}: {model!r} must be {{input, output}} in US dollars per million tokens, "
                f"got {entry!r}"
            )
        prices[model] = Price(*(float(cast(float, values[key])) for key in ("input", "output")))
    return prices


def _is_price(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf
