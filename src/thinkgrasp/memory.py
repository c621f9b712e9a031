"""What was tried before on this scene, so that it is not tried again in the same way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.geometry import apply, invert
from thinkgrasp.types import Grasp, Grasps, Outcome, Proposal

MAX_FAILURES = 3
"""After so many failed attempts a thing is left for later."""
SAME_PLACE_M = 0.03
SAME_GRASP_M, SAME_GRASP_DEG = 0.012, 20.0


@dataclass(frozen=True, eq=False)
class Attempt:
    """One decision that was acted upon; positions are in the camera frame of the memory that holds it."""

    target: str
    cell: int
    grasp: Grasp | None
    """None: no grasp on the thing survived the checks, so that none was executed."""
    object_center: NDArray[np.float64]
    """(3,) [m] centre of the thing that was reached for."""
    outcome: Outcome

    def moved(self, T: NDArray[np.float64]) -> Attempt:
        """Return the attempt in another frame, T (4, 4) from this one to that."""
        grasp = self.grasp
        if grasp is not None:
            grasp = replace(grasp, rotation=T[:3, :3] @ grasp.rotation, position=apply(T, grasp.position))
        return replace(self, grasp=grasp, object_center=apply(T, self.object_center))


@dataclass(frozen=True, eq=False)
class Memory:
    """The attempts of one episode, oldest first, in the frame of one camera."""

    attempts: tuple[Attempt, ...] = ()
    T_world_camera: NDArray[np.float64] | None = None
    """(4, 4) pose of the camera whose frame the attempts are in; None = a camera that does not move."""

    def remember(self, attempt: Attempt) -> Memory:
        """Return a memory with one more attempt."""
        return replace(self, attempts=(*self.attempts, attempt))

    def seen_from(self, T_world_camera: NDArray[np.float64] | None) -> Memory:
        """Return the same memory in the frame of another camera (4, 4); unchanged where a pose is unknown."""
        if self.T_world_camera is None or T_world_camera is None:
            return replace(self, T_world_camera=T_world_camera)
        if np.array_equal(self.T_world_camera, T_world_camera):
            return self
        T = invert(T_world_camera) @ self.T_world_camera
        return Memory(tuple(a.moved(T) for a in self.attempts), T_world_camera)

    def failures_at(self, proposal: Proposal, radius_m: float = SAME_PLACE_M) -> tuple[Attempt, ...]:
        """Return the failed attempts whose object was within `radius_m` of this proposal's centre."""
        return tuple(a for a in self.attempts if _failed_at(a, proposal, radius_m))

    def is_worn_out(self, proposal: Proposal) -> bool:
        """Whether a thing is to be left for later.

        That is so when no grasp on it survived the checks, and after MAX_FAILURES failed attempts, each time until
        something else was removed; a thing that failed so often gets one more attempt after each removal.
        """
        if self.has_no_grasp(proposal):
            return True
        return bool(self._recent(proposal)) and len(self.failures_at(proposal)) >= MAX_FAILURES

    def has_no_grasp(self, proposal: Proposal) -> bool:
        """Whether no grasp on a thing survived the checks since something was removed last."""
        return any(a.grasp is None for a in self._recent(proposal))

    def _recent(self, proposal: Proposal) -> list[Attempt]:
        """Return the failures at a thing since something was removed last."""
        removals = [i for i, a in enumerate(self.attempts) if a.outcome.success]
        since = removals[-1] + 1 if removals else 0
        return [a for a in self.attempts[since:] if _failed_at(a, proposal, SAME_PLACE_M)]

    def repeats(self, grasps: Grasps) -> NDArray[np.bool_]:
        """Return (N,) True for grasps that failed before: the same place and orientation, either way round."""
        tried = [a.grasp for a in self.attempts if a.grasp is not None and not a.outcome.success]
        same = np.zeros(len(grasps), np.bool_)
        cos = np.cos(np.deg2rad(SAME_GRASP_DEG))
        for grasp in tried:
            near = np.linalg.norm(grasps.positions - grasp.position, axis=1) <= SAME_GRASP_M
            approach = grasps.rotations[:, :, 2] @ grasp.rotation[:, 2] >= cos
            closing = np.abs(grasps.rotations[:, :, 0] @ grasp.rotation[:, 0]) >= cos
            same |= near & approach & closing
        return same


def _failed_at(attempt: Attempt, proposal: Proposal, radius_m: float) -> bool:
    distance = float(np.linalg.norm(attempt.object_center - proposal.center_m))
    return not attempt.outcome.success and distance <= radius_m
