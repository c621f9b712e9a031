"""What every contract check is made of: rules that raise ContractError, and calls that must leave their input alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from thinkgrasp.errors import ConfigError, ContractError, InputError
from thinkgrasp.types import Frame, Mask

T = TypeVar("T")


def has_method(plugin: object, protocol: type) -> None:
    """Refuse what lacks the method of its protocol."""
    if not isinstance(plugin, protocol):
        methods = [m for m in vars(protocol) if not m.startswith("_")]
        raise ContractError(f"{type(plugin).__name__} lacks the method {', '.join(methods)} of {protocol.__name__}")


def rule(holds: bool, call: str, message: str) -> None:
    """Raise ContractError with the call and the message unless the rule holds."""
    if not holds:
        raise ContractError(f"{call}: {message}")


def guard(call: str, function: Callable[[], T]) -> T:
    """Call; what it raises breaks the contract."""
    try:
        return function()
    except Exception as error:
        raise ContractError(
            f"{call} raised {type(error).__name__}: {error}; expected outcomes are values, not exceptions"
        ) from error


def run(call: str, function: Callable[[], T], given: object, kind: type[T], *, deterministic: bool = True) -> T:
    """Call twice; the results must be of `kind` and equal, and what was given must be as before."""
    before = _arrays(given)
    copies = [a.copy() for a in before]
    result = guard(call, function)
    rule(isinstance(result, kind), call, f"must return {kind.__name__}, got {type(result).__name__}")
    for array, copy in zip(before, copies, strict=True):
        same = np.array_equal(array, copy, equal_nan=array.dtype.kind == "f")
        if not same:
            array[...] = copy  # samples are shared with whoever looks at them next
        rule(same, call, f"an input array {array.shape} {array.dtype} was changed; work on a copy")
    if deterministic:
        rule(_equal(result, guard(call, function)), call, "the same input gave another result the second time")
    return result


@dataclass(frozen=True)
class Refusal:
    """A plug-in's word that it cannot do without what is missing."""

    message: str


def unless_refused(function: Callable[[], object]) -> object:
    """Call; a ConfigError or InputError is returned as a Refusal."""
    try:
        return function()
    except (ConfigError, InputError) as error:
        return Refusal(str(error))


def _arrays(value: object) -> list[NDArray[np.generic]]:
    if isinstance(value, np.ndarray):
        return [cast(NDArray[np.generic], value)]
    if isinstance(value, tuple):
        return [a for item in cast(tuple[object, ...], value) for a in _arrays(item)]
    if is_dataclass(value):
        return [a for f in fields(value) for a in _arrays(getattr(value, f.name))]
    return []


def _equal(a: object, b: object) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        x, y = cast(NDArray[np.generic], a), cast(NDArray[np.generic], b)
        return x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f")
    if isinstance(a, tuple) and isinstance(b, tuple):
        xs, ys = cast(tuple[object, ...], a), cast(tuple[object, ...], b)
        return len(xs) == len(ys) and all(_equal(x, y) for x, y in zip(xs, ys, strict=True))
    if is_dataclass(a):
        return all(_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b or (a != a and b != b)  # NaN equals NaN here


def array_rule(call: str, name: str, array: NDArray[np.generic], shape: tuple[int, ...], dtype: type) -> None:
    """Demand this shape and type."""
    ok = array.shape == shape and array.dtype == dtype
    rule(ok, call, f"{name} must be {shape} {np.dtype(dtype)}, got {array.shape} {array.dtype}")


def mask_rule(call: str, name: str, mask: Mask, frame: Frame) -> None:
    """Demand a mask of the frame's size that is not empty."""
    array_rule(call, name, mask, frame.depth.shape, np.bool_)
    rule(bool(mask.any()), call, f"{name} must not be empty")


def box_rule(call: str, name: str, box: tuple[int, int, int, int], mask: Mask) -> None:
    """Demand the mask's tight half-open box."""
    v, u = np.nonzero(mask)
    tight = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
    rule(tuple(box) == tight, call, f"{name} must be the mask's half-open box {tight}, got {tuple(box)}")


def rotation_rule(call: str, name: str, rotations: NDArray[np.floating]) -> None:
    """Demand proper rotations (N, 3, 3)."""
    R = rotations.astype(np.float64)
    proper = np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-3) and bool((np.linalg.det(R) > 0).all())
    rule(proper, call, f"{name} must be proper rotations (orthonormal, determinant +1)")
