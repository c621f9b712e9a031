"""What was tried before on this scene, so that it is not tried again in the same way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.types import Grasp, Outcome, Proposal


@dataclass(frozen=True, eq=False)
class Attempt:
    """One executed decision; positions are in the camera frame of a camera that did not move since."""

    target: str
    cell: int
    grasp: Grasp
    object_center: NDArray[np.float64]
    """(3,) [m] centre of the thing that was reached for."""
    outcome: Outcome


@dataclass(frozen=True)
class Memory:
    """The attempts of one episode, oldest first."""

    attempts: tuple[Attempt, ...] = ()

    def remember(self, attempt: Attempt) -> Memory:
        """Return a memory with one more attempt."""
        return replace(self, attempts=(*self.attempts, attempt))

    def failures_at(self, proposal: Proposal, radius_m: float = 0.03) -> tuple[Attempt, ...]:
        """Return the failed attempts whose object was within `radius_m` of this proposal's centre."""
        return tuple(
            a
            for a in self.attempts
            if not a.outcome.success and float(np.linalg.norm(a.object_center - proposal.center_m)) <= radius_m
        )
