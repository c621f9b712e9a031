"""Options of the command line that choose stages and their settings; every command that runs a pipeline has them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction, arg

from thinkgrasp.errors import ConfigError

if TYPE_CHECKING:
    from thinkgrasp.config import PipelineConfig

ASK_NOTHING = ("offline", "literal")
"""Planners that ask no model."""


@dataclass(frozen=True)
class StageOptions:
    """Which stages run, and with which settings."""

    preset: Annotated[str, arg(metavar="NAME|FILE")] = "offline"
    """A preset (see `thinkgrasp presets`) or a configuration saved as JSON."""
    gripper: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Built-in gripper or a JSON file with its geometry."""
    seed: Annotated[int | None, arg(metavar="INT")] = None
    """Seed of everything random."""
    scene: Annotated[str | None, arg(metavar="NAME")] = None
    """Scene plug-in; "none" turns proposals and graph off (the paper's strict mode)."""
    planner: Annotated[str | None, arg(metavar="NAME")] = None
    """Planner plug-in (see `thinkgrasp plugins`)."""
    segmenter: Annotated[str | None, arg(metavar="NAME")] = None
    """Segmenter plug-in."""
    generator: Annotated[str | None, arg(metavar="NAME")] = None
    """Grasp generator plug-in."""
    record: Annotated[Path | None, arg(metavar="FILE")] = None
    """Keep what a planner asks of its model, and the replies, in this cassette."""
    replay: Annotated[Path | None, arg(metavar="FILE")] = None
    """Answer such a planner from this cassette, without a network or a key."""
    weights: Annotated[Path | None, arg(metavar="FILE")] = None
    """Weights of the generator's network; short for --set generator.weights=FILE."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE")] = ()
    """One setting, for example planner.grid=4 or checks.collision.voxel_m=0.002."""
    debug: bool = False
    """Show the traceback of an error."""


DEFAULT_STAGES = StageOptions()


def configure(options: StageOptions) -> PipelineConfig:
    """Return the configuration that the options ask for.

    Raises:
        ConfigError: An option names what there is not, or does not fit the others.
    """
    from thinkgrasp.config import load_config, override, parse_assignment

    config = load_config(options.preset)
    if options.scene is not None:
        config = override(config, "scene", None if options.scene == "none" else options.scene)
    for key in ("planner", "segmenter", "generator", "gripper", "seed"):
        value = getattr(options, key)
        if value is not None:
            config = override(config, key, value)
    for name in ("record", "replay"):
        value = getattr(options, name)
        if value is not None:
            if config.planner.name in ASK_NOTHING:
                raise ConfigError(
                    f"--{name} is of use only where a model is asked; the planner {config.planner.name!r} asks none: "
                    "add --preset vlm or --planner openai"
                )
            config = override(config, f"planner.{name}", str(value))
    if options.weights is not None:
        config = override(config, "generator.weights", str(options.weights))
    for assignment in options.set:
        config = override(config, *parse_assignment(assignment))
    return config
