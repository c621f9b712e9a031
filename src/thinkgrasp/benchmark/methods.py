"""Methods by name: what runs in the cell, at which quality of an emulated model, with whose perception.

NAME[@ACCURACY][+truth], where NAME is a preset, a configuration saved as JSON, one of the methods below, or a plug-in
in place of the offline preset's own as `planner=NAME`, `segmenter=NAME`, `generator=NAME` or `scene=NAME`. `@1` or
`@0.8` answers its planner's requests with an emulated model that is right so often; without it the real model is asked.
`+truth` replaces its perception by the simulator's.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, cast

from thinkgrasp.benchmark.baselines import (
    ANY_NUMBER,
    BestScore,
    Forgetful,
    PlannedMark,
    RandomObject,
    WithoutGraph,
)
from thinkgrasp.benchmark.chat import MODEL
from thinkgrasp.benchmark.emulator import Quality, VlmEmulator
from thinkgrasp.config import PRESETS, STAGES, PipelineConfig, StageConfig, load_config, make_pipeline, override
from thinkgrasp.errors import ConfigError, ThinkGraspError
from thinkgrasp.loop_stages import for_the_loop
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.sim.oracle import ORACLE, TruthPerception
from thinkgrasp.testbed import Session

_NOBODYS_URL = "http://127.0.0.1:9/v1"
Variant = Literal["oracle", "no-memory", "no-graph", "random-object", "best-score", ""]
VARIANTS: dict[str, str] = {
    ORACLE: "names and masks are the simulator's truth: an upper bound",
    "no-memory": "ablation of offline: nothing that failed is remembered",
    "no-graph": "ablation of offline: it is not known what hides what",
    "random-object": "floor: any object, with its best grasp",
    "nearest-grasp": "floor: offline with the grasp nearest to the preferred point, as the official code takes it",
    "best-score": "floor: the best-scoring grasp anywhere",
}
"""Methods that are no preset, with notes."""


@dataclass(frozen=True)
class Method:
    """Something that can run an episode."""

    name: str
    config: PipelineConfig
    variant: Variant = ""
    accuracy: float | None = None
    """Of the emulated model; None = none is emulated."""
    truth: bool = False
    """Whether perception is the simulator's."""


def parse_method(text: str) -> Method:
    """Read a method's name.

    Raises:
        ConfigError: There is no such method, or an accuracy where no model is asked, or truth where it is already.
    """
    rest, plus, perception = text.partition("+")
    name, at, accuracy = rest.partition("@")
    if plus and perception != "truth":
        raise ConfigError(f"method {text!r}: after + may stand 'truth', got {perception!r}")
    method = replace(_named(name), name=text, truth=bool(plus))
    if method.truth and (method.variant == ORACLE or method.config.scene is None):
        why = "it knows the truth already" if method.variant == ORACLE else "it has no scene stage"
        raise ConfigError(f"method {text!r}: leave out +truth, {why}")
    if not at:
        return method
    if method.config.planner.name != "openai":
        raise ConfigError(f"method {text!r}: {name} asks no model, so that @{accuracy} means nothing; leave it out")
    try:
        quality = Quality(accuracy=float(accuracy))
    except (ValueError, ConfigError):
        raise ConfigError(f"method {text!r}: after @ stands how often the model is right, 0..1") from None
    config = override(method.config, "planner.model", MODEL)
    return replace(method, config=config, accuracy=quality.accuracy)


def _named(name: str) -> Method:
    offline = PRESETS["offline"]
    stage, equals, plugin = name.partition("=")
    if equals and stage in STAGES and plugin:
        return Method(name, override(offline, stage, StageConfig(plugin)))
    if name in ("nearest-grasp", "random-object"):
        nearest = 1 if name == "nearest-grasp" else ANY_NUMBER
        variant = cast(Variant, "" if name == "nearest-grasp" else name)
        return Method(name, override(offline, "n_nearest", nearest), variant)
    if name in VARIANTS:
        return Method(name, offline, cast(Variant, name))
    try:
        return Method(name, load_config(name))
    except ConfigError as error:
        raise ConfigError(f"{error}; or one of {', '.join(VARIANTS)}") from error


def check_methods(methods: Iterable[Method]) -> None:
    """Make the stages of methods once, so that what cannot be made is found before anything runs.

    Raises:
        ConfigError: A stage is missing, needs what is not installed, or does not take its settings.
    """
    for method in methods:
        emulated = method.accuracy is not None
        config = override(method.config, "planner.base_url", _NOBODYS_URL) if emulated else method.config
        try:
            make_pipeline(for_the_loop(config))
        except ThinkGraspError as error:
            raise ConfigError(f"method {method.name!r} cannot run here: {error}") from error


@contextmanager
def running(method: Method, session: Session, task: str, seed: int) -> Iterator[Pipeline]:
    """Give the pipeline of a method in a session, with a server for its model where that is emulated.

    Raises:
        ConfigError: A stage of it does not take its settings.
        MissingDependency: A stage of it needs a package that is not installed.
    """
    number = zlib.crc32(f"{task} {seed}".encode())
    if method.accuracy is None:
        yield _pipeline(method, method.config, session, number)
        return
    grid = cast(int, method.config.planner.settings.get("grid", 3))
    with VlmEmulator(session, Quality(accuracy=method.accuracy), grid=grid, seed=number) as emulator:
        config = override(method.config, "planner.base_url", emulator.base_url)
        yield _pipeline(method, config, session, number)


def _pipeline(method: Method, config: PipelineConfig, session: Session, seed: int) -> Pipeline:
    if method.variant == ORACLE:
        return session.pipeline(ORACLE)
    pipeline = session.pipeline(config)
    if method.truth:
        pipeline.scene = TruthPerception(session.world)
    if method.variant == "random-object":
        pipeline.planner, pipeline.segmenter = RandomObject(seed=seed), PlannedMark()
    if method.variant == "no-graph" and pipeline.scene is not None:
        pipeline.scene = WithoutGraph(pipeline.scene)
    if method.variant == "no-memory":
        return Forgetful.of(pipeline)
    return BestScore.of(pipeline) if method.variant == "best-score" else pipeline
