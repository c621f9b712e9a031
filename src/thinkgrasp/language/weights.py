"""The numbers that decide how strictly words are held against what is seen."""

from __future__ import annotations

from dataclasses import dataclass

from thinkgrasp.errors import ConfigError


@dataclass(frozen=True)
class Weights:
    """How strictly usual and said properties are judged, and when a match is accepted.

    The defaults come from reasoning about single views and from rendered development scenes
    (`benchmarks/grounding.py`); `benchmarks/leave_one_out.py` says how much they depend on the frames at hand.

    Raises:
        ConfigError: A weight is negative or not finite.
    """

    min_score: float = 0.35
    """A match below this does not answer to the query."""
    lone_described: float = 0.5
    """Share of min_score that a match needs where nothing comes near it and a colour or shape was said."""
    rivalry: float = 1.8
    """Exponent on a match's share of the best rival name's fit."""
    rivalry_described: float = 0.7
    """The same where a colour or shape was said too: who describes a thing has most likely seen it."""
    rival_discount: float = 0.9
    """The name that was said has this advantage over all those that were not."""
    natural: float = 0.5
    """What a match loses where the thing has the form and the colour of a fruit or vegetable that was not asked for."""
    any_color_fit: float = 0.75
    """Colour says little of a thing that comes in any colour."""
    odd_color_fit: float = 0.15
    """What is left of a thing in a colour that it never has."""
    missing_shape: float = 1.0
    """Exponent on what is left where an expected shape is not seen."""
    unexpected_shape: float = 1.0
    """Factor on what a shape takes away that is seen but not expected."""
    size_slack: float = 1.0
    """Factor on the tolerances of sizes."""
    said_color: float = 0.35
    """A colour that was said is contradicted below this degree."""
    confidence: float = 0.25
    """Exponent on perception's confidence that a proposal is one whole object."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < float("inf"):
                raise ConfigError(f"language weight {name} must be finite and not negative, got {value}")


DEFAULT_WEIGHTS = Weights()
