"""Hand-eye calibration: AX = XB from poses of an arm and of a board, with an error that was not fitted to.

Two arrangements. "fixed": the camera stands still, the board is on the arm's flange; sought is T_base_camera. "hand":
the camera is on the flange, the board lies still; sought is T_flange_camera. OpenCV's solvers all run; what the one
finds that fits best is refined by least squares over camera and board at once. Each pose's error is held out: it is
that of a refinement without the pose and its repetitions.

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
from scipy.optimize import least_squares
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
SAME_DEG, SAME_MM = 3.0, 10.0
"""Two poses whose arms differ by no more are one: the other does not predict it, but repeats it."""
SECOND_AXIS_SHARE = 0.05
"""Of all turns that has to be about another axis than the main one."""
MM_PER_DEG = 9.0
"""How errors of turn weigh against those of place: a degree moves what is half a metre away by this much."""
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
        InputError: Too few different poses, numbers that are not finite, or motions that do not determine the result.
        MissingDependency: OpenCV is not installed.
    """
    check_motions(samples)
    arm, seen = _stacks(samples, mount)
    starts = {name: X for name in SOLVERS if (X := _linear(arm, seen, name)) is not None}
    if not starts:
        raise InputError("no solver finds the camera's place from these poses; take more, from more different places")
    fits = {name: _places(arm, seen, X) for name, X in starts.items()}
    solver = min(fits, key=lambda name: float(np.median(_errors(arm, seen, *fits[name])[0])))
    X, Z = _refined(arm, seen, *fits[solver])
    held_out = np.empty((2, len(samples)))
    same = _same(samples)
    for i in range(len(samples)):
        rest = ~same[i]
        held_out[:, i] = np.ravel(_errors(arm[i : i + 1], seen[i : i + 1], *_refined(arm[rest], seen[rest], X, Z)))
    fitted = float(np.median(_errors(arm, seen, X, Z)[0]))
    names = tuple(s.name or str(i + 1) for i, s in enumerate(samples))
    return HandEye(mount, X, Z, solver, held_out[0], held_out[1], fitted, names)


def check_motions(samples: Sequence[Sample]) -> None:
    """Refuse poses from which the camera's place does not follow.

    Raises:
        InputError: Too few that differ, not finite, hardly turned, or turned about one axis only.
    """
    if len(samples) < MIN_POSES:
        raise InputError(f"{len(samples)} usable poses are too few; at least {MIN_POSES} are needed, 15 are good")
    for s in samples:
        for what, T in (("the arm", s.T_base_flange), ("the board", s.T_camera_board)):
            if T.shape != (4, 4) or not np.isfinite(T).all():
                raise InputError(f"pose {s.name or '?'} of {what} is no finite 4x4 matrix")
    different = _different(_same(samples))
    if different < MIN_POSES:
        raise InputError(
            f"of {len(samples)} poses only {different} are more than {SAME_DEG:g} deg or {SAME_MM:g} mm from one "
            f"another; at least {MIN_POSES} are needed"
        )
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


def repeats(samples: Sequence[Sample], T_base_flange: Float) -> str:
    """Return the name of the sample that the arm was at the place of; empty where it is at a new one."""
    same = _same([*samples, Sample(T_base_flange, np.eye(4))])[-1, :-1]
    return next((s.name for s, is_same in zip(samples, same, strict=True) if is_same), "")


def _same(samples: Sequence[Sample]) -> NDArray[np.bool_]:
    """Return (N, N) True where the arm was at the same place in two samples."""
    arm = np.stack([s.T_base_flange for s in samples])
    apart_mm = np.linalg.norm(arm[:, None, :3, 3] - arm[None, :, :3, 3], axis=-1) * 1e3
    R = np.einsum("aki,bkj->abij", arm[:, :3, :3], arm[:, :3, :3])
    apart_deg = np.degrees(Rotation.from_matrix(R.reshape(-1, 3, 3)).magnitude()).reshape(apart_mm.shape)
    return (apart_mm <= SAME_MM) & (apart_deg <= SAME_DEG)


def _different(same: NDArray[np.bool_]) -> int:
    """How many samples are at a place where none before them was."""
    return sum(not same[i, :i].any() for i in range(len(same)))


def _stacks(samples: Sequence[Sample], mount: Mount) -> tuple[Float, Float]:
    """Return (N, 4, 4) of the arm and of the board as seen, such that seen = X^-1 arm Z.

    With the camera fixed that is T_base_flange; with the camera on the hand, its inverse.
    """
    arm = np.stack([s.T_base_flange if mount == "fixed" else invert(s.T_base_flange) for s in samples])
    return arm, np.stack([s.T_camera_board for s in samples])


def _linear(arm: Float, seen: Float, solver: str) -> Float | None:
    """Return X (4, 4) by one of OpenCV's solvers; None where it fails."""
    cv = opencv()
    moved = np.linalg.inv(arm)  # for OpenCV the camera is always on the hand
    try:
        R, t = cv.calibrateHandEye(
            list(moved[:, :3, :3]),
            list(moved[:, :3, 3]),
            list(seen[:, :3, :3]),
            list(seen[:, :3, 3]),
            method=getattr(cv, SOLVERS[solver]),
        )
    except cv.error:
        return None
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    u, _, vt = np.linalg.svd(R)
    R = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    return make_transform(R, np.asarray(t).ravel())


def _places(arm: Float, seen: Float, X: Float) -> tuple[Float, Float]:
    """Return X and the mean place of the board, which is the same in all samples but for errors."""
    places = np.linalg.inv(arm) @ X @ seen
    R = Rotation.from_matrix(places[:, :3, :3]).mean().as_matrix()
    return X, make_transform(R, np.median(places[:, :3, 3], axis=0))


def _refined(arm: Float, seen: Float, X: Float, Z: Float) -> tuple[Float, Float]:
    """Return camera and board moved to where the sum of the squares of all errors is least."""

    def moved(change: Float) -> tuple[Float, Float]:
        turns = Rotation.from_rotvec(change[:6].reshape(2, 3)).as_matrix()
        return X @ make_transform(turns[0], change[6:9]), Z @ make_transform(turns[1], change[9:])

    def errors(change: Float) -> Float:
        off = _off(arm, seen, *moved(change))
        turns = np.degrees(Rotation.from_matrix(off[:, :3, :3]).as_rotvec()) * MM_PER_DEG
        return np.concatenate([off[:, :3, 3] * 1e3, turns]).ravel()

    return moved(least_squares(errors, np.zeros(12), method="lm").x)


def _off(arm: Float, seen: Float, X: Float, Z: Float) -> Float:
    """Return the boards as seen (N, 4, 4), each in the frame of where X and Z put it."""
    return np.linalg.inv(np.linalg.inv(X) @ arm @ Z) @ seen


def _errors(arm: Float, seen: Float, X: Float, Z: Float) -> tuple[Float, Float]:
    """Return how far (N,) [mm] and how much turned (N,) [deg] each board was from where X and Z put it."""
    off = _off(arm, seen, X, Z)
    turns = np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude())
    return np.linalg.norm(off[:, :3, 3], axis=1) * 1e3, np.atleast_1d(turns)
