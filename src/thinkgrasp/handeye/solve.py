"""Hand-eye calibration: AX = XB from poses of an arm and of a board, with an error that was not fitted to.

Two arrangements. "fixed": the camera stands still, the board is on the arm's flange; sought is T_base_camera. "hand":
the camera is on the flange, the board lies still; sought is T_flange_camera. OpenCV's solvers all run, and the one
whose held-out error is smallest is taken.

References:
    Park and Martin 1994; Horaud and Dornaika 1995; Daniilidis 1999; Tsai and Lenz 1989 (the solvers, in OpenCV).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.geometry import invert, make_transform
from thinkgrasp.handeye.board import opencv

Float = NDArray[np.float64]
Mount = Literal["fixed", "hand"]

SOLVERS = {
    "park": "CALIB_HAND_EYE_PARK",
    "horaud": "CALIB_HAND_EYE_HORAUD",
    "daniilidis": "CALIB_HAND_EYE_DANIILIDIS",
    "tsai": "CALIB_HAND_EYE_TSAI",
}
MIN_POSES = 8
TURN_DEG = 15.0
"""Two poses whose arms are turned by less against one another say little about the rotation."""
SECOND_AXIS_SHARE = 0.05
"""Of all turns that has to be about another axis than the main one."""
OUTLIER_FACTOR, OUTLIER_MM = 4.0, 5.0


@dataclass(frozen=True, eq=False)
class Sample:
    """One place of the arm from which the board was seen."""

    T_base_flange: Float
    """(4, 4)."""
    T_camera_board: Float
    """(4, 4)."""
    name: str = ""


@dataclass(frozen=True, eq=False)
class HandEye:
    """A calibration and how good it is."""

    mount: Mount
    T_camera: Float
    """(4, 4) T_base_camera ("fixed") or T_flange_camera ("hand")."""
    T_board: Float
    """(4, 4) T_flange_board ("fixed") or T_base_board ("hand")."""
    solver: str
    held_out_mm: Float
    """(N,) how far the board was from where a calibration from the other poses puts it."""
    held_out_deg: Float
    """(N,)."""
    fitted_mm: float
    """Median over the poses that were fitted to; always smaller, and no measure of accuracy."""
    names: tuple[str, ...]

    @property
    def median_mm(self) -> float:
        """Median held-out error."""
        return float(np.median(self.held_out_mm))

    @property
    def median_deg(self) -> float:
        """Median held-out error."""
        return float(np.median(self.held_out_deg))

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the poses that fit far worse than the others: the board slipped, or was seen badly."""
        bad = self.held_out_mm > max(OUTLIER_MM, OUTLIER_FACTOR * self.median_mm)
        return tuple(n for n, b in zip(self.names, bad, strict=True) if b)


def solve(samples: Sequence[Sample], mount: Mount) -> HandEye:
    """Find where the camera is.

    Args:
        samples: At least MIN_POSES, from places that are turned against one another about at least two axes.
        mount: What carries the camera.

    Raises:
        InputError: Too few poses, numbers that are not finite, or motions that do not determine the result.
        MissingDependency: OpenCV is not installed.
    """
    check_motions(samples)
    everything = range(len(samples))
    best: tuple[float, str, list[tuple[float, float]]] | None = None
    for solver in SOLVERS:
        errors: list[tuple[float, float]] = []
        for i in everything:
            rest = [samples[k] for k in everything if k != i]
            X = _solve(rest, mount, solver)
            if X is None:
                break
            errors.append(_error(samples[i], X, _board(rest, X, mount), mount))
        else:
            score = float(np.median([mm for mm, _ in errors]))
            if best is None or score < best[0]:
                best = score, solver, errors
    if best is None:
        raise InputError("no solver finds the camera's place from these poses; take more, from more different places")
    _, solver, errors = best
    X = _solve(samples, mount, solver)
    if X is None:
        raise InputError("no solver finds the camera's place from all poses; take more, from more different places")
    Z = _board(samples, X, mount)
    fitted = [_error(s, X, Z, mount)[0] for s in samples]
    held_out = np.array(errors)
    names = tuple(s.name or str(i + 1) for i, s in enumerate(samples))
    return HandEye(mount, X, Z, solver, held_out[:, 0], held_out[:, 1], float(np.median(fitted)), names)


def check_motions(samples: Sequence[Sample]) -> None:
    """Refuse poses from which the camera's place does not follow.

    Raises:
        InputError: Too few, not finite, hardly turned, or turned about one axis only.
    """
    if len(samples) < MIN_POSES:
        raise InputError(f"{len(samples)} usable poses are too few; at least {MIN_POSES} are needed, 15 are good")
    for s in samples:
        for what, T in (("the arm", s.T_base_flange), ("the board", s.T_camera_board)):
            if T.shape != (4, 4) or not np.isfinite(T).all():
                raise InputError(f"pose {s.name or '?'} of {what} is no finite 4x4 matrix")
    turns = [
        Rotation.from_matrix(a.T_base_flange[:3, :3].T @ b.T_base_flange[:3, :3]).as_rotvec()
        for a, b in combinations(samples, 2)
    ]
    angles = np.linalg.norm(turns, axis=1)
    large = angles > np.radians(TURN_DEG)
    if large.mean() < 0.5:
        raise InputError(
            f"the arm was turned too little between the poses (median {np.degrees(np.median(angles)):.0f} "
            "deg); turn the "
            f"wrist by more than {TURN_DEG:g} deg from pose to pose"
        )
    axes = np.array(turns)[large] / angles[large][:, None]
    shares = np.linalg.eigvalsh(axes.T @ axes / len(axes))[::-1]
    if shares[1] < SECOND_AXIS_SHARE:
        raise InputError(
            f"all poses are turned about one axis ({shares[0]:.0%} of the turns), so that the camera's "
            "place along it does "
            "not follow; tilt the board about a second axis too"
        )


def _solve(samples: Sequence[Sample], mount: Mount, solver: str) -> Float | None:
    """Return T_base_camera ("fixed") or T_flange_camera ("hand"); None where the solver fails."""
    cv = opencv()
    # With the board on the flange, the base takes the flange's part.
    arm = [s.T_base_flange if mount == "hand" else invert(s.T_base_flange) for s in samples]
    seen = [s.T_camera_board for s in samples]
    try:
        R, t = cv.calibrateHandEye(
            [T[:3, :3] for T in arm],
            [T[:3, 3] for T in arm],
            [T[:3, :3] for T in seen],
            [T[:3, 3] for T in seen],
            method=getattr(cv, SOLVERS[solver]),
        )
    except cv.error:
        return None
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    u, _, vt = np.linalg.svd(R)
    R = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    return make_transform(R, np.asarray(t).ravel())


def _carried(s: Sample, X: Float, mount: Mount) -> Float:
    """Return where a sample puts the board on the flange ("fixed") or in the base frame ("hand")."""
    if mount == "fixed":
        return invert(s.T_base_flange) @ X @ s.T_camera_board
    return s.T_base_flange @ X @ s.T_camera_board


def _board(samples: Sequence[Sample], X: Float, mount: Mount) -> Float:
    """Return the mean place of the board; it is the same in all samples, but for errors."""
    places = [_carried(s, X, mount) for s in samples]
    R = Rotation.from_matrix([T[:3, :3] for T in places]).mean().as_matrix()
    return make_transform(R, np.median([T[:3, 3] for T in places], axis=0))


def _error(s: Sample, X: Float, Z: Float, mount: Mount) -> tuple[float, float]:
    """Return how far [mm] and how much turned [deg] the board was from where X and Z put it."""
    arm = s.T_base_flange if mount == "fixed" else invert(s.T_base_flange)
    expected = invert(X) @ arm @ Z
    turn = Rotation.from_matrix(expected[:3, :3].T @ s.T_camera_board[:3, :3]).magnitude()
    return float(np.linalg.norm(expected[:3, 3] - s.T_camera_board[:3, 3])) * 1e3, float(np.degrees(turn))
