"""Two-finger gripper geometry: what has to fit into the scene for a grasp to be possible.

All bodies are boxes in the grasp frame (origin = TCP midway between the fingertips, +z approach, +x closing):
two fingers along -z from the tips, and a palm behind them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError


@dataclass(frozen=True)
class Gripper:
    """Geometry of a parallel two-finger gripper [m].

    Raises:
        ConfigError: A length is not positive, or the widths are not ordered.
    """

    name: str
    max_width_m: float
    """Largest opening between the finger pads."""
    finger_length_m: float
    """From the fingertip back to the palm, along the approach."""
    finger_thickness_m: float
    """Along the closing direction, outside the opening."""
    finger_breadth_m: float
    """Along y."""
    palm_size_m: tuple[float, float, float]
    """Palm box: along closing, y, approach."""
    pad_length_m: float
    """Length of the pad that may touch the object, from the tip."""
    min_width_m: float = 0.0

    def __post_init__(self) -> None:
        lengths = (
            self.max_width_m,
            self.finger_length_m,
            self.finger_thickness_m,
            self.finger_breadth_m,
            self.pad_length_m,
            *self.palm_size_m,
        )
        if len(self.palm_size_m) != 3 or not all(np.isfinite(v) and 0 < v < 1 for v in lengths):
            raise ConfigError(f"gripper {self.name!r}: every length must lie in (0, 1) m, got {lengths}")
        if not 0 <= self.min_width_m < self.max_width_m:
            raise ConfigError(f"gripper {self.name!r}: need 0 <= min_width_m < max_width_m")
        if self.pad_length_m > self.finger_length_m:
            raise ConfigError(f"gripper {self.name!r}: pad_length_m is longer than finger_length_m")

    def bodies(self, width_m: float) -> NDArray[np.float64]:
        """Return the boxes (3, 2, 3) of left finger, right finger and palm as (min, max) corners in the grasp frame."""
        half, t, b = width_m / 2, self.finger_thickness_m, self.finger_breadth_m / 2
        px, py, pz = self.palm_size_m
        L = self.finger_length_m
        return np.array(
            [
                [[-half - t, -b, -L], [-half, b, 0.0]],
                [[half, -b, -L], [half + t, b, 0.0]],
                [[-px / 2, -py / 2, -L - pz], [px / 2, py / 2, -L]],
            ]
        )

    @classmethod
    def load(cls, name_or_path: str | Path) -> Gripper:
        """Return a built-in gripper by name, or one from a JSON file with this class's fields.

        Raises:
            ConfigError: Neither a built-in name nor a readable file; or the file lacks fields or has unknown ones.
        """
        if str(name_or_path) in GRIPPERS:
            return GRIPPERS[str(name_or_path)]
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(f"no gripper {str(name_or_path)!r}: built-in are {sorted(GRIPPERS)}, or give a JSON file")
        try:
            data = json.loads(path.read_text())
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ConfigError(f"gripper file {path} is not readable JSON: {error}") from error
        known = {f.name for f in fields(cls)}
        if not isinstance(data, dict) or set(data) - known:
            raise ConfigError(f"gripper file {path} must be an object with the fields {sorted(known)}")
        try:
            gripper = cls(**data)
            return replace(gripper, palm_size_m=tuple(gripper.palm_size_m))
        except TypeError as error:
            raise ConfigError(f"gripper file {path}: {error}; fields are {sorted(known)}") from error

    def to_dict(self) -> dict[str, object]:
        """Return the fields as plain values, as `load` reads them."""
        return asdict(self)


GRIPPERS = {
    g.name: g
    for g in (
        Gripper("robotiq_2f85", 0.085, 0.060, 0.012, 0.022, (0.110, 0.075, 0.060), 0.038),
        Gripper("franka_hand", 0.080, 0.046, 0.014, 0.021, (0.204, 0.063, 0.066), 0.018),
        Gripper("generic", 0.080, 0.050, 0.010, 0.020, (0.100, 0.060, 0.050), 0.030),
    )
}
