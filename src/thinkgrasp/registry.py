"""Plug-ins by entry point: built-in stages take the same route as third-party ones.

A package offers a stage by an entry point in the group `thinkgrasp.<kind>`, whose object is a class or factory called
with the stage's settings as keyword arguments. Nothing is imported until it is loaded.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, cast, get_args

from thinkgrasp import interfaces
from thinkgrasp.errors import ConfigError, ContractError, PluginNotFound

Kind = Literal["scene", "planner", "segmenter", "generator", "check", "camera", "robot", "recorder"]
KINDS: tuple[Kind, ...] = get_args(Kind)

_PROTOCOLS: dict[Kind, type] = {
    "scene": interfaces.ScenePerception,
    "planner": interfaces.Planner,
    "segmenter": interfaces.Segmenter,
    "generator": interfaces.GraspGenerator,
    "check": interfaces.Check,
    "camera": interfaces.Camera,
    "robot": interfaces.Robot,
    "recorder": interfaces.Recorder,
}


def available(kind: Kind) -> dict[str, EntryPoint]:
    """Return the installed plug-ins of a kind by name, sorted, without importing them.

    Raises:
        ConfigError: Two packages offer different objects under one name, or the kind is unknown.
    """
    if kind not in KINDS:
        raise ConfigError(f"unknown plug-in kind {kind!r}; kinds are {', '.join(KINDS)}")
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=f"thinkgrasp.{kind}"):
        other = found.get(point.name)
        if other is not None and other.value != point.value:
            raise ConfigError(
                f"two packages offer the {kind} {point.name!r}: {other.value} and {point.value}; remove one"
            )
        found[point.name] = point
    return dict(sorted(found.items()))


def load(kind: Kind, name: str, **config: object) -> Any:
    """Make the plug-in `name` of a kind with these settings.

    Raises:
        PluginNotFound: No such plug-in; the message lists those that exist.
        ConfigError: The plug-in cannot be imported or does not take these settings.
        ContractError: What it makes does not have the kind's methods.
    """
    points = available(kind)
    if name not in points:
        close = difflib.get_close_matches(name, points, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise PluginNotFound(f"no {kind} named {name!r}; installed: {', '.join(points) or 'none'}.{hint}")
    try:
        factory = cast(Callable[..., object], points[name].load())
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{kind} {name!r} ({points[name].value}) cannot be imported: {error}") from error
    try:
        plugin = factory(**config)
    except TypeError as error:
        raise ConfigError(f"{kind} {name!r} does not take the settings {sorted(config)}: {error}") from error
    if not isinstance(plugin, _PROTOCOLS[kind]):
        raise ContractError(
            f"{kind} {name!r} made {type(plugin).__name__}, which lacks the methods of the {kind} contract"
        )
    return plugin
