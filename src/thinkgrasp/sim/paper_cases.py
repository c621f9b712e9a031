"""Layouts of the published benchmark: a file per scene, read with catalogue objects of the same kind.

A file's first line is the instruction, its second the indices of the objects that serve it; then follows one line
`urdf x y z roll pitch yaw` per object, in the order in which they are dropped. Lengths are in metres, angles in
radians about fixed axes, the frame is the world's.

References:
    Xu et al. 2023, "A Joint Modeling of Vision-Language-Action for Target-oriented Grasping in Clutter"; Qian et al.
    2024, "ThinkGrasp".
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.objects import SimObject

Float = NDArray[np.float64]

POSE_LIMIT_M = 2.0
"""A drop farther from the robot than this is a mistake."""


@dataclass(frozen=True, eq=False)
class Layout:
    """One published scene of N objects."""

    name: str
    """The file's name without its ending: "case00-round"."""
    instruction: str
    goals: tuple[int, ...]
    """Indices of the objects that serve the instruction."""
    ids: tuple[str, ...]
    """Published object per drop, "set/file": "simplified_objects/015"."""
    names: tuple[str, ...]
    """Catalogue object of the same kind, per drop."""
    poses: Float
    """(N, 4, 4) T_world_object to drop from, in order."""

    def objects(self, seed: int = 0, own: Mapping[str, SimObject] | None = None) -> tuple[SimObject, ...]:
        """Return the objects (N), an object that occurs twice looking the same.

        Args:
            seed: Of the catalogue's variation.
            own: Objects to use instead, by published id ("015" or "simplified_objects/015").

        Raises:
            InputError: `own` names an id that the layout does not have.
        """
        own = own or {}
        known = {id_ for full in self.ids for id_ in (full, PurePosixPath(full).name)}
        if strange := sorted(own.keys() - known):
            raise InputError(
                f"layout {self.name!r} has no object {strange[0]!r}; it has {', '.join(sorted(set(self.ids)))}"
            )
        made: dict[str, SimObject] = {}
        for id_, name in zip(self.ids, self.names, strict=True):
            if id_ not in made:
                real = own.get(id_) or own.get(PurePosixPath(id_).name)
                made[id_] = real if real is not None else catalogue.make(name, seed)
        return tuple(made[id_] for id_ in self.ids)


def list_cases(folder: Path | str) -> tuple[Path, ...]:
    """Return the layout files below a folder, sorted: those in it and in its sub-folders.

    Raises:
        InputError: There are none.
    """
    folder = Path(folder)
    cases = sorted([*folder.glob("*.txt"), *folder.glob("*/*.txt")])
    if not cases:
        raise InputError(f"{folder}: holds no layouts (*.txt), nor do its sub-folders")
    return tuple(cases)


def load_case(file: Path | str) -> Layout:
    """Read one layout.

    Raises:
        InputError: The file cannot be read or breaks the format, or an object has no counterpart in the catalogue; the
            message starts with "file:line:".
    """
    path = Path(file)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    drops = [(i, line.split()) for i, line in enumerate(lines[2:], start=3) if line.strip()]
    if not lines or not lines[0].strip():
        raise InputError(f"{path}:1: the instruction is missing")
    if not drops:
        raise InputError(f"{path}:{max(len(lines), 1)}: no objects; from line 3 on each line is one object")
    goals = _goals(path, lines[1], len(drops))
    read = [_drop(f"{path}:{i}", words) for i, words in drops]
    ids, names, poses = zip(*read, strict=True)
    return Layout(path.stem, lines[0].strip(), goals, ids, names, np.stack(poses))


def _goals(path: Path, line: str, count: int) -> tuple[int, ...]:
    where = f"{path}:2"
    try:
        goals = tuple(int(word) for word in line.split())
    except ValueError:
        raise InputError(f"{where}: the goals must be whole numbers with spaces between, got {line!r}") from None
    if not goals:
        raise InputError(f"{where}: no goals; name the index of at least one object, the first is 0")
    for goal in goals:
        if not 0 <= goal < count:
            raise InputError(f"{where}: goal {goal} is no object; there are {count}, from 0 to {count - 1}")
    if len(set(goals)) < len(goals):
        raise InputError(f"{where}: a goal occurs twice in {line!r}")
    return goals


def _drop(where: str, words: list[str]) -> tuple[str, str, Float]:
    if len(words) != 7:
        raise InputError(f"{where}: an object is `urdf x y z roll pitch yaw`, 7 words, got {len(words)}")
    try:
        values = np.array([float(word) for word in words[1:]])
    except ValueError:
        values = np.full(6, np.nan)
    if not np.isfinite(values).all():
        raise InputError(f"{where}: x y z roll pitch yaw must be 6 finite numbers, got {' '.join(words[1:])!r}")
    if np.abs(values[:3]).max() > POSE_LIMIT_M:
        raise InputError(
            f"{where}: a position must lie within {POSE_LIMIT_M} m of the robot, got {words[1:4]}; in metres?"
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    id_ = _published_id(where, words[0])
    return id_, _table()[id_], T


def _published_id(where: str, urdf: str) -> str:
    path = PurePosixPath(urdf)
    id_ = f"{path.parent.name}/{path.stem}"
    if path.suffix != ".urdf" or id_ not in _table():
        close = difflib.get_close_matches(id_, _table(), n=1)
        hint = f"; did you mean {close[0]}.urdf?" if close else ""
        raise InputError(f"{where}: {urdf!r} is none of the {len(_table())} published objects{hint}")
    return id_


@lru_cache(maxsize=1)
def _table() -> dict[str, str]:
    text = resources.files("thinkgrasp.sim").joinpath("paper_objects.toml").read_text(encoding="utf-8")
    return {f"{folder}/{id_}": name for folder, rows in tomllib.loads(text).items() for id_, name in rows.items()}


def published_names() -> tuple[str, ...]:
    """Return the catalogue objects that stand for published ones, each once."""
    return tuple(dict.fromkeys(_table().values()))
