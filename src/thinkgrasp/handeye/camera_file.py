"""What a calibration writes into a camera file, and what a run reads of it."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.handeye.board import Board
from thinkgrasp.handeye.solve import HandEye
from thinkgrasp.lab.agreement import CalibrationRecord
from thinkgrasp.outputs import write_atomic
from thinkgrasp.types import CameraIntrinsics

Float = NDArray[np.float64]

RECORD = "hand_eye"
"""Key of the record in a camera file."""
_POSES = {"fixed": "T_world_camera", "hand": "T_flange_camera"}


def write_camera_file(
    path: Path, camera: CameraIntrinsics, result: HandEye, board: Board, T_world_base: Float
) -> dict[str, Any]:
    """Write pose and record into a camera file, made if needed; what else it says stays. Returns what it holds now.

    Raises:
        InputError: It is there and no JSON object, or cannot be written.
    """
    data: dict[str, Any] = _read(path) if path.exists() else {}
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        data[name] = getattr(camera, name)
    for stale in _POSES.values():
        data.pop(stale, None)
    T = T_world_base @ result.T_camera if result.mount == "fixed" else result.T_camera
    data[_POSES[result.mount]] = T.tolist()
    data[RECORD] = {
        "mount": result.mount,
        "board": board.words(),
        "solver": result.solver,
        "poses": len(result.names),
        "held_out_mm": {"median": round(result.median_mm, 3), "max": round(float(result.held_out_mm.max()), 3)},
        "held_out_deg": {"median": round(result.median_deg, 4), "max": round(float(result.held_out_deg.max()), 4)},
        "T_world_base": T_world_base.tolist(),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_atomic(path, (json.dumps(data, indent=2) + "\n").encode())
    return data


def read_pose(path: Path, mount: Literal["fixed", "hand"]) -> Float:
    """Return T_world_camera ("fixed") or T_flange_camera ("hand") (4, 4) of a camera file.

    Raises:
        InputError: It lacks that, or it is no rigid transform.
    """
    data, key = _read(path), _POSES[mount]
    if key not in data:
        raise InputError(
            f"camera file {path} lacks {key}, which a camera that is mounted {mount!r} needs; run: thinkgrasp calibrate"
        )
    return _transform(data[key], f"camera file {path}: {key}")


def has_pose(path: Path) -> bool:
    """Whether a camera file says where its camera is.

    Raises:
        InputError: It is no JSON object.
    """
    return any(key in _read(path) for key in _POSES.values())


def read_record(path: Path) -> CalibrationRecord | None:
    """Return what a camera file says of how its pose was found; None where it says nothing.

    Raises:
        InputError: What it says cannot be read.
    """
    data = _read(path)
    if RECORD not in data:
        return None
    record, where = data[RECORD], f"camera file {path}: {RECORD}"
    try:
        if record["mount"] not in _POSES:
            raise ValueError(f"mount is {record['mount']!r}")
        return CalibrationRecord(
            mount=record["mount"],
            T_world_base=_transform(record["T_world_base"], f"{where}.T_world_base"),
            held_out_mm=float(record["held_out_mm"]["median"]),
            held_out_deg=float(record["held_out_deg"]["median"]),
            poses=int(record["poses"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where} is not what thinkgrasp calibrate writes: {error!r}") from error


def _transform(value: object, where: str) -> Float:
    try:
        T = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} must be 4 rows of 4 numbers") from error
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
        raise InputError(f"{where} must be 4 rows of 4 finite numbers, the last 0 0 0 1")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError(f"{where} must be a rigid transform: its rotation is not orthonormal and right-handed")
    return T


def _read(path: Path) -> dict[str, Any]:
    try:
        data: object = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"camera file {path} is not readable JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f"camera file {path} must hold a JSON object, got a {type(data).__name__}")
    return cast(dict[str, Any], data)
