"""Presets as Python objects; overridden by name, saved as JSON beside each result.

A configuration names one plug-in per stage and its settings. Nothing of a stage is imported before `make_pipeline`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

from thinkgrasp import registry
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import Gripper
from thinkgrasp.pipeline import Pipeline

SCHEMA = "thinkgrasp/config-1"
Stage = Literal["scene", "planner", "segmenter", "generator"]
STAGES: tuple[Stage, ...] = ("scene", "planner", "segmenter", "generator")
_KEYS = (*STAGES, "checks", "gripper", "n_nearest", "seed")


@dataclass(frozen=True)
class StageConfig:
    """A plug-in by its registered name, and the keyword arguments of its constructor."""

    name: str
    settings: Mapping[str, object] = field(default_factory=dict[str, object])

    def with_setting(self, key: str, value: object) -> StageConfig:
        """Return a copy with one setting changed."""
        return replace(self, settings={**self.settings, key: value})


@dataclass(frozen=True)
class PipelineConfig:
    """Everything that a Pipeline is made from.

    Raises:
        ConfigError: n_nearest is not positive, the seed is negative, or a check occurs twice.
    """

    planner: StageConfig
    segmenter: StageConfig
    generator: StageConfig
    checks: tuple[StageConfig, ...]
    scene: StageConfig | None = None
    """None: the paper's strict mode, without proposals, graph and support plane."""
    gripper: str | Gripper = "robotiq_2f85"
    """A built-in gripper's name, a JSON file, or the geometry itself."""
    n_nearest: int = 10
    """How many grasps nearest to the preferred point compete on score."""
    seed: int = 0

    def __post_init__(self) -> None:
        for key, least in (("n_nearest", 1), ("seed", 0)):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{key} must be a whole number of at least {least}, got {value!r}")
        names = [c.name for c in self.checks]
        if len(set(names)) != len(names):
            raise ConfigError(f"each check may occur once, got {', '.join(names)}")


_OFFLINE = PipelineConfig(
    scene=StageConfig("geometric"),
    planner=StageConfig("offline"),
    segmenter=StageConfig("geometric"),
    generator=StageConfig("antipodal"),
    checks=tuple(
        StageConfig(name) for name in ("target", "width", "workspace", "force_closure", "table_clearance", "collision")
    ),
)


def _asking(style: str, **settings: object) -> StageConfig:
    return StageConfig("openai", {"style": style, **settings})


_PAPER_SEGMENTER = StageConfig("geometric")
"""What finds the paper's targets in the image; it was LangSAM, and VLPart for parts: the segmenter `cascade`."""


def _as_in_the_paper(generator: str, **planner: object) -> PipelineConfig:
    return PipelineConfig(
        scene=StageConfig("geometric"),
        planner=_asking("paper", without_key="offline", **planner),
        segmenter=_PAPER_SEGMENTER,
        generator=StageConfig(generator),
        checks=tuple(StageConfig(name) for name in ("target", "width", "workspace", "model_free_collision", "nms")),
    )


PRESETS: dict[str, PipelineConfig] = {
    "offline": _OFFLINE,
    "learned": replace(_OFFLINE, generator=StageConfig("vgn_antipodal")),
    "vlm": replace(_OFFLINE, planner=_asking("marks")),
    "vlm-paper": replace(_OFFLINE, planner=_asking("paper")),
    "paper-sim": _as_in_the_paper("graspnet"),
    "paper-real": _as_in_the_paper("fgc_graspnet", image_width=640),
    "no-vlm": replace(_OFFLINE, planner=StageConfig("literal")),
    "no-grid": replace(_OFFLINE, planner=_asking("paper", grid=1)),
    "vlm-crop": replace(_OFFLINE, planner=_asking("paper"), segmenter=StageConfig("plan_box")),
    "vlm-only": replace(_OFFLINE, planner=_asking("point", grid=1), segmenter=StageConfig("plan_point")),
    **{f"grid-{k}": replace(_OFFLINE, planner=_asking("paper", grid=k)) for k in (2, 3, 4)},
}
"""What `--preset` takes. One entry per preset."""

PRESET_NOTES: dict[str, str] = {
    "offline": "no network, GPU, key or download: perception and grasps from geometry, language from a rule book",
    "learned": "offline, with grasps from VGN too: needs --weights PATH of vgn_conv.pth, see docs/vgn.md",
    "vlm": "a vision-language model chooses among numbered marks (extra vlm, and a key or a server: docs/vlm.md)",
    "vlm-paper": "a vision-language model sees the plain picture, as in the paper; what it names is found by geometry",
    "no-vlm": "ablation: no planner, the instruction itself is looked for",
    "no-grid": "ablation of vlm-paper: the middle of the target's box instead of a cell (a grid of 1 x 1)",
    "vlm-crop": "ablation of vlm-paper: the model's own box crops the cloud, nothing is segmented",
    "vlm-only": "ablation: the model names the pixel to grasp at, nothing is segmented",
    "grid-2": "ablation of vlm-paper: a grid of 2 x 2",
    "grid-3": "the same as vlm-paper, whose grid is 3 x 3",
    "grid-4": "ablation of vlm-paper: a grid of 4 x 4",
    "paper-sim": "GPT-4o (the offline planner without a key) and GraspNet-1Billion, as the paper in simulation; needs "
    "--weights, which are for non-commercial research only",
    "paper-real": "GPT-4o (the offline planner without a key) and FGC-GraspNet, as the paper on its robot; needs "
    "--weights, which are for non-commercial research only",
}


SIMULATION_PRESETS: dict[str, str] = {
    "oracle": "in simulation only (thinkgrasp demo --preset oracle): names and masks are the simulator's truth",
}
"""Presets that are no configuration, since they need the running simulator; with their notes."""


def load_config(preset_or_file: str | Path) -> PipelineConfig:
    """Return a preset by name, or the configuration saved in a JSON file.

    Raises:
        ConfigError: Neither a preset nor a readable configuration file; or a preset of the simulator's.
    """
    name = str(preset_or_file)
    if name in PRESETS:
        return PRESETS[name]
    if name in SIMULATION_PRESETS:
        raise ConfigError(f"preset {name!r} belongs to the simulator: use it as thinkgrasp demo --preset {name}")
    path = Path(preset_or_file)
    if path.suffix == ".json" or path.is_file():
        try:
            return from_json(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"configuration file {path} cannot be read: {error}") from error
        except ConfigError as error:
            raise ConfigError(f"configuration file {path}: {error}") from error
    raise ConfigError(f"no preset {name!r}; {_choices(name, [*PRESETS, *SIMULATION_PRESETS])}, or a .json file")


def override(config: PipelineConfig, key: str, value: object) -> PipelineConfig:
    """Return the configuration with one entry changed.

    Args:
        config: What to start from.
        key: "planner", "scene", "segmenter", "generator", "checks", "gripper", "n_nearest", "seed"; or a setting of a
            stage as "planner.<setting>", of a check as "checks.<name>.<setting>".
        value: For a stage a name, a StageConfig, or (scene only) None; for "checks" an iterable of those.

    Raises:
        ConfigError: The key or the value is not allowed.
    """
    head, _, rest = key.partition(".")
    if head not in _KEYS:
        raise ConfigError(f"no configuration key {key!r}; {_choices(head, _KEYS)}")
    if head == "checks":
        if not rest:
            return replace(config, checks=_checks(value))
        name, _, setting = rest.partition(".")
        names = [c.name for c in config.checks]
        if name not in names or not setting:
            raise ConfigError(f"{key!r} must be checks.<name>.<setting>; {_choices(name, names)}")
        changed = tuple(c.with_setting(setting, value) if c.name == name else c for c in config.checks)
        return replace(config, checks=changed)
    if head in STAGES:
        if not rest:
            return replace(config, **cast(Any, {head: _stage(head, value)}))
        stage = cast(StageConfig | None, getattr(config, head))
        if stage is None:
            raise ConfigError(f"{key!r} cannot be set: this configuration has no {head} stage")
        return replace(config, **cast(Any, {head: stage.with_setting(rest, value)}))
    if rest:
        raise ConfigError(f"{head} has no settings; write {head}=VALUE")
    if head == "gripper" and not isinstance(value, str | Path | Gripper):
        raise ConfigError(f"gripper must be a name, a JSON file or a Gripper, got {value!r}")
    return replace(config, **cast(Any, {head: str(value) if isinstance(value, Path) else value}))


def parse_assignment(text: str, option: str = "--set") -> tuple[str, object]:
    """Split "key=value" of an option of the command line; the value is read as JSON, or else as text.

    Raises:
        ConfigError: There is no "=" or no key.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        example = "planner.grid=4" if option == "--set" else "fps=15"
        raise ConfigError(f"{option} takes KEY=VALUE, for example {example}, got {text!r}")
    try:
        return key.strip(), json.loads(value)
    except (ValueError, RecursionError):
        return key.strip(), value


def make_pipeline(config: str | Path | PipelineConfig = "offline", **overrides: object) -> Pipeline:
    """Load every stage of a preset or configuration.

    Args:
        config: A preset's name, a saved JSON file, or a configuration.
        **overrides: As in `override`; keys with dots go in as `**{"planner.grid": 4}`.

    Raises:
        ConfigError: An entry is not allowed, or a stage is missing or does not take its settings.
    """
    if not isinstance(config, PipelineConfig):
        config = load_config(config)
    for key, value in overrides.items():
        config = override(config, key, value)
    return Pipeline(
        scene=None if config.scene is None else _load("scene", config.scene),
        planner=_load("planner", config.planner),
        segmenter=_load("segmenter", config.segmenter),
        generator=_load("generator", config.generator),
        checks={check.name: _load("check", check) for check in config.checks},
        gripper=config.gripper if isinstance(config.gripper, Gripper) else Gripper.load(config.gripper),
        n_nearest=config.n_nearest,
        seed=config.seed,
    )


def to_json(config: PipelineConfig) -> str:
    """Return the configuration as JSON that `from_json` reads back to an equal one."""
    gripper = config.gripper.to_dict() if isinstance(config.gripper, Gripper) else config.gripper
    data: dict[str, object] = {"schema": SCHEMA}
    for stage in STAGES:
        chosen = cast(StageConfig | None, getattr(config, stage))
        data[stage] = None if chosen is None else _stage_dict(chosen)
    data |= {"checks": [_stage_dict(c) for c in config.checks], "gripper": gripper}
    data |= {"n_nearest": config.n_nearest, "seed": config.seed}
    try:
        return json.dumps(data, indent=2) + "\n"
    except (TypeError, ValueError) as error:
        raise ConfigError(f"this configuration holds a setting that JSON cannot: {error}") from error


def from_json(text: str) -> PipelineConfig:
    """Read what `to_json` wrote.

    Raises:
        ConfigError: It is not JSON, of another schema, or has missing or unknown entries.
    """
    try:
        data: object = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"not readable as JSON: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"a configuration must be a JSON object, got a {type(data).__name__}")
    entries = dict(cast(dict[str, object], data))
    schema = entries.pop("schema", None)
    if schema != SCHEMA:
        raise ConfigError(f"schema is {schema!r}, this version reads {SCHEMA!r}")
    unknown = sorted(set(entries) - set(_KEYS))
    if unknown:
        raise ConfigError(f"unknown entry {unknown[0]!r}; {_choices(unknown[0], _KEYS)}")
    missing = [key for key in ("planner", "segmenter", "generator", "checks") if key not in entries]
    if missing:
        raise ConfigError(f"lacks {', '.join(missing)}")
    gripper = entries.get("gripper", "robotiq_2f85")
    if isinstance(gripper, dict):
        gripper = _gripper_from_dict(cast(dict[str, Any], gripper))
    return PipelineConfig(
        planner=_required("planner", entries["planner"]),
        segmenter=_required("segmenter", entries["segmenter"]),
        generator=_required("generator", entries["generator"]),
        checks=_checks(entries["checks"]),
        scene=_stage("scene", entries.get("scene")),
        gripper=cast(str | Gripper, gripper),
        n_nearest=cast(int, entries.get("n_nearest", 10)),
        seed=cast(int, entries.get("seed", 0)),
    )


def _gripper_from_dict(data: dict[str, Any]) -> Gripper:
    values: dict[str, Any] = {k: tuple(cast(list[float], v)) if isinstance(v, list) else v for k, v in data.items()}
    try:
        return Gripper(**values)
    except TypeError as error:
        raise ConfigError(f"gripper: {error}") from error


def _load(kind: registry.Kind, stage: StageConfig) -> Any:
    try:
        return registry.load(kind, stage.name, **stage.settings)
    except ValueError as error:
        raise ConfigError(f"{kind} {stage.name!r} refuses its settings {dict(stage.settings)}: {error}") from error


def _stage(key: str, value: object) -> StageConfig | None:
    if isinstance(value, StageConfig):
        return value
    if isinstance(value, str) and value:
        return StageConfig(value)
    if value is None and key == "scene":
        return None
    if isinstance(value, dict):
        entry = cast(dict[str, object], value)
        name, settings = entry.get("name"), entry.get("settings", {})
        if isinstance(name, str) and isinstance(settings, dict) and set(entry) <= {"name", "settings"}:
            return StageConfig(name, cast(dict[str, object], settings))
    raise ConfigError(f'{key} must be a plug-in name or {{"name": ..., "settings": {{...}}}}, got {value!r}')


def _required(key: str, value: object) -> StageConfig:
    stage = _stage(key, value)
    if stage is None:
        raise ConfigError(f"{key} must not be empty")
    return stage


def _checks(value: object) -> tuple[StageConfig, ...]:
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        raise ConfigError(f"checks must be a list of check names, got {value!r}")
    return tuple(_required("checks", item) for item in cast(Iterable[object], value))


def _stage_dict(stage: StageConfig) -> dict[str, object]:
    return {"name": stage.name, "settings": dict(stage.settings)}


def _choices(wrong: str, known: Iterable[str]) -> str:
    names = list(known)
    close = difflib.get_close_matches(wrong, names, n=1)
    return (f"did you mean {close[0]!r}? " if close else "") + f"allowed: {', '.join(names)}"
