"""Camera calibration files: pinhole intrinsics, depth scale and camera pose, in the spellings met in the wild."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import InputError
from thinkgrasp.types import CameraIntrinsics

ALIASES = {
    "width": ("width", "img_width", "image_width"),
    "height": ("height", "img_height", "image_height"),
    "fx": ("fx",),
    "fy": ("fy",),
    "cx": ("cx", "x_offset", "ppx"),
    "cy": ("cy", "y_offset", "ppy"),
}
MATRIX_KEYS = ("K", "k", "intrinsic_matrix", "camera_matrix", "intrinsics")
NESTED_KEYS = ("camera", "intrinsic")
DISTORTION_KEYS = ("D", "d", "coeffs", "distortion", "dist_coeffs")


@dataclass(frozen=True)
class Upload:
    """The content of a file that came without one, for example over a network, and what to call it in messages."""

    name: str
    data: bytes

    @property
    def suffix(self) -> str:
        """What the file's name would end in, as far as the content says it: ".npy" or nothing."""
        return ".npy" if self.data.startswith(b"\x93NUMPY") else ""

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a camera file says; `size_wh` is None where it does not name the image size."""

    fx: float
    fy: float
    cx: float
    cy: float
    size_wh: tuple[int, int] | None
    depth_scale: float | None
    T_world_camera: NDArray[np.float64] | None

    def intrinsics(self, size_wh: tuple[int, int]) -> CameraIntrinsics:
        """Return the intrinsics, with the file's size or, where it has none, this one."""
        width, height = self.size_wh or size_wh
        return CameraIntrinsics(width, height, self.fx, self.fy, self.cx, self.cy)


def read_calibration(path: str | Path | Upload) -> Calibration:
    """Read a camera file.

    Accepted are JSON objects with fx, fy, cx, cy (or x_offset/y_offset, ppx/ppy), or a 3x3 matrix under K, k,
    intrinsic_matrix or camera_matrix (nested, flat row-major as in ROS CameraInfo, or flat column-major as in Open3D);
    with width, height, depth_scale and T_world_camera as options; the same one level down under "camera"; and
    GraspNet's meta.mat (intrinsic_matrix, factor_depth).

    Raises:
        InputError: The file cannot be read, lacks keys, or a value is not what it should be.
    """
    if not isinstance(path, Upload):
        path = Path(path)
    data = _read_mat(path) if isinstance(path, Path) and path.suffix.lower() == ".mat" else _read_json(path)
    where = f"camera file {path}"
    for key in NESTED_KEYS:
        inner = data.get(key)
        if isinstance(inner, dict):
            data = {**data, **cast(dict[str, object], inner)}
            break
    _reject_distortion(data, where)
    fx, fy, cx, cy = _pinhole(data, where)
    width, height = (_size(data, name, where) for name in ("width", "height"))
    if (width is None) != (height is None):
        raise InputError(f"{where} has only one of width and height; give both or neither")
    return Calibration(
        fx,
        fy,
        cx,
        cy,
        None if width is None or height is None else (width, height),
        _depth_scale(data, where),
        _pose(data, where),
    )


def check_depth_scale(value: float, where: str) -> float:
    """Return the scale [m per unit] if it is positive and finite, else raise InputError naming `where`."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{where}: depth scale must be a positive number of metres per unit, got {value}")
    return value


def require_file(path: Path, what: str) -> None:
    """Raise InputError unless `path` is a readable, non-empty file."""
    try:
        if not path.exists():
            raise InputError(f"{what} {path} does not exist")
        if not path.is_file():
            raise InputError(f"{what} {path} is {'a directory' if path.is_dir() else 'not a regular file'}")
        if path.stat().st_size == 0:
            raise InputError(f"{what} {path} is empty (0 bytes)")
    except (OSError, ValueError) as error:
        raise InputError(f"{what} {str(path)!r} cannot be read: {error}") from error


def _read_json(path: Path | Upload) -> dict[str, object]:
    if isinstance(path, Path):
        require_file(path, "camera file")
    try:
        data: object = json.loads((path.read_bytes() if isinstance(path, Path) else path.data).decode("utf-8-sig"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"camera file {path} is not readable JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f"camera file {path} must hold a JSON object with fx, fy, cx, cy, got a {type(data).__name__}")
    return cast(dict[str, object], data)


def _read_mat(path: Path) -> dict[str, object]:
    from scipy.io import loadmat

    require_file(path, "camera file")
    try:
        data = loadmat(str(path))
    except Exception as error:  # scipy raises a different type for nearly every way a file can be broken
        raise InputError(f"camera file {path} is not a readable MATLAB file: {error}") from error
    if "intrinsic_matrix" not in data:
        names = sorted(k for k in data if not k.startswith("_"))
        raise InputError(f"camera file {path} lacks intrinsic_matrix; it has {', '.join(names) or 'nothing'}")
    found: dict[str, object] = {"intrinsic_matrix": np.asarray(data["intrinsic_matrix"]).tolist()}
    if "factor_depth" in data:
        values: list[object] = np.asarray(data["factor_depth"]).ravel().tolist()
        factor = _number(values[0] if values else None, "factor_depth", f"camera file {path}")
        if factor <= 0:
            raise InputError(f"camera file {path}: factor_depth must be positive, got {factor:g}")
        found["depth_scale"] = 1.0 / factor
    return found


def _number(value: object, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {name} must be a number, got {_short(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{where}: {name} must be finite, got {number}")
    return number


def _short(value: object) -> str:
    try:
        text = json.dumps(value)
    except (TypeError, ValueError):
        text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _lookup(data: Mapping[str, object], name: str) -> object:
    return next((data[key] for key in ALIASES[name] if key in data), _ABSENT)


_ABSENT = object()


def _pinhole(data: Mapping[str, object], where: str) -> tuple[float, float, float, float]:
    names = ("fx", "fy", "cx", "cy")
    found = {name: _lookup(data, name) for name in names}
    missing = [name for name in names if found[name] is _ABSENT]
    matrix_key = next((key for key in MATRIX_KEYS if isinstance(data.get(key), list)), None)
    if missing and matrix_key is not None:
        K = _matrix(data[matrix_key], matrix_key, where)
        return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    if missing:
        raise InputError(
            f"{where} lacks {', '.join(missing)}; it needs fx, fy, cx, cy [px] or a 3x3 K, and may have "
            f"width, height, depth_scale, T_world_camera; it has {', '.join(sorted(data)[:12]) or 'nothing'}"
        )
    values = [_number(found[name], name, where) for name in names]
    return values[0], values[1], values[2], values[3]


def _matrix(value: object, name: str, where: str) -> NDArray[np.float64]:
    rows = cast(list[object], value)
    flat = [x for row in rows for x in (cast(list[object], row) if isinstance(row, list) else [row])]
    if len(flat) != 9:
        raise InputError(f"{where}: {name} must be a 3x3 matrix or 9 numbers, got {len(flat)} numbers")
    K = np.array([_number(x, name, where) for x in flat]).reshape(3, 3)
    if not np.allclose(K[2], [0, 0, 1]):
        K = K.T  # Open3D writes it column by column
    if not np.allclose(K[2], [0, 0, 1]) or K[1, 0] != 0:
        raise InputError(f"{where}: {name} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {_short(value)}")
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
        raise InputError(f"{where}: {name} has skew {K[0, 1]:g}, which is not supported; rectify the images")
    return K


def _size(data: Mapping[str, object], name: str, where: str) -> int | None:
    value = _lookup(data, name)
    if value is _ABSENT:
        return None
    number = _number(value, name, where)
    if number != int(number) or number <= 0:
        raise InputError(f"{where}: {name} must be a positive whole number of pixels, got {number:g}")
    return int(number)


def _depth_scale(data: Mapping[str, object], where: str) -> float | None:
    value = data.get("depth_scale")
    return None if value is None else check_depth_scale(_number(value, "depth_scale", where), where)


def _pose(data: Mapping[str, object], where: str) -> NDArray[np.float64] | None:
    value = data.get("T_world_camera")
    if value is None:
        return None
    rows = cast(list[object], value) if isinstance(value, list) else []
    if len(rows) != 4 or not all(isinstance(r, list) and len(cast(list[object], r)) == 4 for r in rows):
        raise InputError(f"{where}: T_world_camera must be 4 rows of 4 numbers, got {_short(value)}")
    T = np.array([[_number(x, "T_world_camera", where) for x in cast(list[object], row)] for row in rows])
    R = T[:3, :3]
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], [0, 0, 0, 1])):
        raise InputError(
            f"{where}: T_world_camera must be a rigid transform (orthonormal right-handed rotation, translation in "
            f"metres, last row 0 0 0 1); its rotation has determinant {np.linalg.det(R):.3g}"
        )
    return T


def _reject_distortion(data: Mapping[str, object], where: str) -> None:
    for key in DISTORTION_KEYS:
        values = data.get(key)
        if isinstance(values, list) and any(_number(x, key, where) != 0 for x in cast(list[object], values)):
            raise InputError(
                f"{where}: lens distortion ({key} = {_short(values)}) is not supported; "
                f"rectify the images and give the rectified intrinsics without {key}"
            )
