"""What a server grants a request: sizes, times, and how many at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from thinkgrasp.errors import ConfigError

STAGE_TIMEOUTS_S: dict[str, float] = {
    "decode": 10,
    "scene": 20,
    "plan": 90,
    "segment": 60,
    "generate": 60,
    "check": 30,
    "pictures": 30,
    "total": 240,
}
"""Time limit of each stage, and of a whole request from its worker on; an episode's step may decide several times."""


@dataclass(frozen=True)
class Limits:
    """Everything that bounds what one request may cost.

    Raises:
        ConfigError: A number is out of its range, or a stage is unknown.
    """

    body_mb: float = 48
    """A request's body [megabytes of 10**6 bytes]."""
    megapixels: float = 8
    """An image, by what its header says, before it is decoded."""
    header_timeout_s: float = 10
    """From a connection's first byte, or its opening, to the end of a request's headers."""
    body_timeout_s: float = 20
    """From the headers to the end of the body."""
    keep_alive_s: float = 15
    """How long an idle connection is kept."""
    send_timeout_s: float = 60
    """For an answer to be taken by its client."""
    queue: int = 8
    """Requests that may wait while every worker is busy; one more is answered with 429."""
    wait_s: float = 300
    """A request that no worker has taken for so long is answered with 429, or with 503 where no worker is usable."""
    connections: int = 512
    """Open connections; one more is closed at once."""
    episodes: int = 256
    """Open episodes."""
    episode_ttl_s: float = 900
    """An episode without a request for so long is forgotten."""
    cancel_grace_s: float = 2
    """A stage that goes on for so long after its client left is ended with its process."""
    stage_timeouts_s: Mapping[str, float] = field(default_factory=lambda: dict(STAGE_TIMEOUTS_S))

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "stage_timeouts_s":
                self._check_stages(value)
            elif f.name in ("queue", "connections", "episodes"):
                least = 0 if f.name == "queue" else 1
                if isinstance(value, bool) or not isinstance(value, int) or value < least:
                    raise ConfigError(f"{f.name} must be a whole number of at least {least}, got {value!r}")
            elif not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{f.name} must be positive, got {value!r}")

    def _check_stages(self, stages: Mapping[str, float]) -> None:
        for name, seconds in stages.items():
            if name not in STAGE_TIMEOUTS_S:
                raise ConfigError(f"no stage {name!r} has a time limit; stages are {', '.join(STAGE_TIMEOUTS_S)}")
            if not (math.isfinite(seconds) and seconds > 0):
                raise ConfigError(f"the time limit of {name} must be positive, got {seconds!r}")

    @property
    def body_bytes(self) -> int:
        """The body's limit in bytes."""
        return int(self.body_mb * 1e6)

    @property
    def pixels(self) -> int:
        """An image's limit in pixels."""
        return int(self.megapixels * 1e6)

    def stage_timeout_s(self, stage: str) -> float:
        """Return the time limit of a stage; one that has none of its own has the total's."""
        return self.stage_timeouts_s.get(stage, STAGE_TIMEOUTS_S.get(stage, self.total_timeout_s))

    @property
    def total_timeout_s(self) -> float:
        """The time limit of a whole request."""
        return self.stage_timeouts_s.get("total", STAGE_TIMEOUTS_S["total"])
