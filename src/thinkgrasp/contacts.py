"""Two-finger force closure from the contacts alone: what the grasp score of the paper means.

A core module, so that generators score with the same function that the force-closure check filters with. Where a
grasp's fingers meet a mesh or a cloud is in `thinkgrasp.closure`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FRICTIONS = tuple(round(1.0 - 0.1 * i, 1) for i in range(10))
"""Friction coefficients tried, from 1.0 down to 0.1."""
EVALUATED_FRICTIONS = (1.2, 1.0, 0.8, 0.6, 0.4, 0.2)
"""Coefficients at which GraspNet-1Billion evaluates predicted grasps."""

_EPS = 1e-9


def contact_angles(
    contacts_a: NDArray[np.floating],
    contacts_b: NDArray[np.floating],
    normals_a: NDArray[np.floating],
    normals_b: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the angles between each contact's inward normal and the line to the other contact.

    Args:
        contacts_a: First contacts, (N, 3) [m].
        contacts_b: Second contacts, (N, 3) [m].
        normals_a: Outward unit surface normals at the first contacts, (N, 3).
        normals_b: Outward unit surface normals at the second contacts, (N, 3).

    Returns:
        Two arrays (N,) [rad] in 0..pi; pi where the contacts coincide or a normal has no length.
    """
    line = np.asarray(contacts_b, np.float64) - np.asarray(contacts_a, np.float64)
    length = np.linalg.norm(line, axis=-1)

    def angle(normal: NDArray[np.floating], sign: float) -> NDArray[np.float64]:
        normal = np.asarray(normal, np.float64)
        along = sign * np.sum(normal * line, axis=-1)
        across = np.linalg.norm(np.cross(normal, line), axis=-1)
        bad = (length < _EPS) | ~(np.linalg.norm(normal, axis=-1) > _EPS)
        return np.where(bad, np.pi, np.arctan2(across, along))

    return angle(normals_a, -1.0), angle(normals_b, 1.0)


def smallest_friction(
    contacts_a: NDArray[np.floating],
    contacts_b: NDArray[np.floating],
    normals_a: NDArray[np.floating],
    normals_b: NDArray[np.floating],
    *,
    frictions: tuple[float, ...] = FRICTIONS,
    oriented: bool = True,
) -> NDArray[np.float64]:
    """Return the smallest friction coefficient of those tried at which each contact pair is force closed.

    Two contacts with friction are closed if and only if the line between them lies in both friction cones, that is,
    both contact angles are at most arctan(mu).

    Args:
        contacts_a: First contacts, (N, 3) [m].
        contacts_b: Second contacts, (N, 3) [m].
        normals_a: Outward unit surface normals at the first contacts, (N, 3).
        normals_b: Outward unit surface normals at the second contacts, (N, 3).
        frictions: Coefficients tried, largest first.
        oriented: False: a normal may point to either side, and its length counts for nothing.

    Returns:
        (N,) coefficient; inf where the pair is not closed even at the largest.

    References:
        Nguyen, Constructing force-closure grasps, IJRR 1988. Fang et al., GraspNet-1Billion, CVPR 2020, section 3.
    """
    if not oriented:
        line = np.asarray(contacts_b, np.float64) - np.asarray(contacts_a, np.float64)
        normals_a, normals_b = _turned(normals_a, -line), _turned(normals_b, line)
    return friction_of_angle(np.maximum(*contact_angles(contacts_a, contacts_b, normals_a, normals_b)), frictions)


def _turned(vectors: NDArray[np.floating], towards: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (N, 3), each with the sign that points towards a direction (N, 3)."""
    along = np.sum(np.asarray(vectors, np.float64) * towards, axis=-1, keepdims=True)
    return np.asarray(np.where(along < 0, -1.0, 1.0) * vectors, np.float64)


def friction_of_angle(angle: NDArray[np.floating], frictions: tuple[float, ...] = FRICTIONS) -> NDArray[np.float64]:
    """Return the smallest coefficient, of those tried, whose cone holds a contact angle (N,) [rad]; inf beyond all."""
    ascending = frictions[::-1]
    limits = np.arctan(np.array(ascending)) + _EPS
    step = np.searchsorted(limits, np.asarray(angle, np.float64), side="left")
    return np.append(ascending, np.inf)[step]


def closure_score(friction: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return s = 1.1 - mu, 0.1..1, of coefficients (N,); 0 where the pair is not closed (mu = inf)."""
    friction = np.asarray(friction, np.float64)
    closed = np.isfinite(friction)
    return np.where(closed, 1.1 - np.where(closed, friction, 1.0), 0.0)


def force_closure_score(
    contacts_a: NDArray[np.floating],
    contacts_b: NDArray[np.floating],
    normals_a: NDArray[np.floating],
    normals_b: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Return the paper's grasp score s = 1.1 - mu of contact pairs: 0.1..1, and 0 where they do not close.

    Arguments are those of `smallest_friction`.

    References:
        Qian et al., ThinkGrasp, CoRL 2024, section 3.3.
    """
    return closure_score(smallest_friction(contacts_a, contacts_b, normals_a, normals_b))
