"""An episode as files: the schemas, and reading back what was recorded.

FOLDER/
  header.json           EpisodeHeader: what was asked, of which preset and seed
  episode.jsonl         StepLine per finished step; written last, so what is listed is complete
  episode.json          EpisodeModel; there once the episode has ended
  report.html           the page for people, renewed after every step
  episode.webp          the video, if one was made
  steps/001/
    color.png depth.png camera.json     the frame
    view2/ view3/ ...                   the same of the views that were fused with it, where it was decided on several
    decision.json                       DecisionModel
    scene.json                          SceneModel: what perception saw
    outcome.json                        OutcomeModel, or null where nothing was executed
    overlay.png panel.html              the step for people
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from thinkgrasp.errors import InputError
from thinkgrasp.schema import (
    Box,
    DecisionModel,
    Finite,
    TimingsModel,
    UsageModel,
    Vector,
    decision_to_schema,
    mask_to_png,
)
from thinkgrasp.types import Decision, Outcome, Proposal, Relation, Scene, Usage

EPISODE_SCHEMA = "thinkgrasp/episode-1"
SCENE_SCHEMA = "thinkgrasp/scene-1"

HEADER_FILE = "header.json"
LOG_FILE = "episode.jsonl"
EPISODE_FILE = "episode.json"
REPORT_FILE = "report.html"
VIDEO_FILE = "episode.webp"
STEPS_FOLDER = "steps"

Named = tuple[str, Finite]
"""A name with its share or degree."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    def to_json(self, indent: int | None = None) -> str:
        """Return the JSON text with the published key names."""
        return self.model_dump_json(by_alias=True, indent=indent)


class EpisodeHeader(_Model):
    """What was asked of what, known before the first step."""

    instruction: str
    goal: str
    """Name of the object that ends the episode; empty when unknown."""
    preset: str
    seed: int


class OutcomeModel(_Model):
    """What became of an executed grasp."""

    success: bool
    reason: str


class StepLine(_Model):
    """One finished step in episode.jsonl."""

    step: Annotated[int, Field(ge=1)]
    status: Literal["grasp", "no_target", "no_grasp"]
    role: Literal["goal", "obstruction"]
    target: str
    mark: int | None
    cell: int
    outcome: OutcomeModel | None
    duration_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Wall time since the previous step was recorded: looking, deciding, executing and verifying."""
    timings_ms: TimingsModel


class ProposalModel(_Model):
    """One thing that perception believed to be an object; `center_m` is in the camera frame."""

    mark: int
    box_xyxy: Box
    mask_png: str
    center_m: Vector
    extents_m: Vector
    height_m: tuple[Finite, Finite]
    colors: tuple[Named, ...]
    shapes: tuple[Named, ...]
    touches_border: bool
    confidence: Finite


class ObstructionModel(_Model):
    """`a` hides, rests on, or blocks the way to `b` (marks)."""

    relation: Relation
    a: int
    b: int
    evidence: Finite
    unit: Literal["px", "m"]


class SupportModel(_Model):
    """The support: points p of the camera frame with normal . p + offset_m = 0."""

    normal: Vector
    offset_m: Finite
    residual_m: Finite


class SceneModel(_Model):
    """What perception saw in one frame."""

    schema_: Annotated[Literal["thinkgrasp/scene-1"], Field(alias="schema")] = SCENE_SCHEMA
    support: SupportModel | None
    proposals: tuple[ProposalModel, ...]
    obstructions: tuple[ObstructionModel, ...]


class EpisodeUsageModel(UsageModel):
    """What the planner's model spent in an episode, for decisions that were not acted upon too."""

    latency_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class EpisodeModel(_Model):
    """A whole episode: what `demo --json` prints and episode.json holds."""

    schema_: Annotated[Literal["thinkgrasp/episode-1"], Field(alias="schema")] = EPISODE_SCHEMA
    success: bool
    steps: Annotated[int, Field(ge=0)]
    end: str
    """Named reason."""
    instruction: str
    goal: str
    preset: str
    seed: int
    out: str
    decisions: tuple[DecisionModel, ...]
    outcomes: tuple[OutcomeModel | None, ...]
    """One for each decision; null where nothing was executed."""
    usage: EpisodeUsageModel


class StepLike(Protocol):
    """What `episode_to_schema` needs of a step."""

    @property
    def decision(self) -> Decision: ...

    @property
    def outcome(self) -> Outcome | None: ...


@dataclass(frozen=True)
class RecordedStep:
    """One finished step as it lies in its folder."""

    line: StepLine
    folder: Path

    def decision(self) -> DecisionModel:
        """Read the decision."""
        return _read(self.folder / "decision.json", DecisionModel)

    def scene(self) -> SceneModel:
        """Read what perception saw."""
        return _read(self.folder / "scene.json", SceneModel)


@dataclass(frozen=True)
class RecordedEpisode:
    """What a folder holds of an episode that ended, is running, or was killed."""

    folder: Path
    header: EpisodeHeader
    steps: tuple[RecordedStep, ...]
    ended: EpisodeModel | None
    """None while it runs, or when it was killed."""


def read_episode(folder: str | Path) -> RecordedEpisode:
    """Read the finished steps of an episode; a step that was being written when the process died is left out.

    Raises:
        InputError: The folder holds no recorded episode, or a file of it is not what was written.
    """
    folder = Path(folder)
    header = _read(folder / HEADER_FILE, EpisodeHeader)
    steps: list[RecordedStep] = []
    log = folder / LOG_FILE
    lines = log.read_bytes().split(b"\n") if log.is_file() else [b""]
    for line in lines[:-1]:  # what follows the last line end is a line torn by the end of the process
        try:
            found = StepLine.model_validate_json(line)
        except ValidationError as error:
            raise InputError(f"{log} line {len(steps) + 1} is not a recorded step: {_first(error)}") from error
        steps.append(RecordedStep(found, step_folder(folder, found.step)))
    ended = _read(folder / EPISODE_FILE, EpisodeModel) if (folder / EPISODE_FILE).is_file() else None
    return RecordedEpisode(folder, header, tuple(steps), ended)


def step_folder(folder: Path, step: int) -> Path:
    """Return the folder of a step (counted from 1)."""
    return folder / STEPS_FOLDER / f"{step:03d}"


def outcome_to_schema(outcome: Outcome | None) -> OutcomeModel | None:
    """Turn an outcome into its published form."""
    return None if outcome is None else OutcomeModel(success=outcome.success, reason=outcome.reason)


def scene_to_schema(scene: Scene) -> SceneModel:
    """Turn what perception saw into its published form."""
    support = scene.support
    return SceneModel(
        support=None
        if support is None
        else SupportModel(
            normal=_triple(support.normal), offset_m=float(support.offset_m), residual_m=float(support.residual_m)
        ),
        proposals=tuple(map(_proposal, scene.proposals)),
        obstructions=tuple(
            ObstructionModel(relation=e.relation, a=e.a, b=e.b, evidence=round(float(e.evidence), 6), unit=e.unit)
            for e in scene.obstructions
        ),
    )


def _proposal(proposal: Proposal) -> ProposalModel:
    x0, y0, x1, y1 = (int(c) for c in proposal.box_xyxy)
    low, high = (round(float(h), 6) for h in proposal.height_m)
    return ProposalModel(
        mark=proposal.mark,
        box_xyxy=(x0, y0, x1, y1),
        mask_png=mask_to_png(proposal.mask),
        center_m=_triple(proposal.center_m),
        extents_m=_triple(proposal.extents_m),
        height_m=(low, high),
        colors=tuple((name, round(float(share), 4)) for name, share in proposal.colors),
        shapes=tuple((name, round(float(degree), 4)) for name, degree in proposal.shapes),
        touches_border=bool(proposal.touches_border),
        confidence=round(float(proposal.confidence), 4),
    )


def episode_to_schema(
    steps: Iterable[StepLike],
    *,
    header: EpisodeHeader,
    end: str,
    success: bool,
    out: str | Path,
    usage: Usage,
    with_masks: bool = True,
) -> EpisodeModel:
    """Turn the steps of an episode into its published form.

    Args:
        steps: Decisions with their outcomes, oldest first.
        header: What was asked.
        end: Named reason why the episode ended.
        success: Whether the goal was reached.
        out: Folder of the records; empty when nothing was recorded.
        usage: What all decisions cost.
        with_masks: Whether to include the targets' masks as PNG.
    """
    pairs = [(decision_to_schema(s.decision, with_mask=with_masks), outcome_to_schema(s.outcome)) for s in steps]
    return assemble_episode(pairs, header=header, end=end, success=success, out=out, usage=usage)


def assemble_episode(
    pairs: Iterable[tuple[DecisionModel, OutcomeModel | None]],
    *,
    header: EpisodeHeader,
    end: str,
    success: bool,
    out: str | Path,
    usage: Usage,
) -> EpisodeModel:
    """Put published decisions and outcomes together, as `episode_to_schema` does."""
    pairs = list(pairs)
    return EpisodeModel(
        success=success,
        steps=len(pairs),
        end=end,
        instruction=header.instruction,
        goal=header.goal,
        preset=header.preset,
        seed=header.seed,
        out=str(out),
        decisions=tuple(decision for decision, _ in pairs),
        outcomes=tuple(outcome for _, outcome in pairs),
        usage=EpisodeUsageModel(
            model=usage.model,
            prompt_tokens=usage.prompt_tokens,
            completion_tokens=usage.completion_tokens,
            usd=usage.usd,
            requests=usage.requests,
            latency_s=round(usage.latency_s, 3),
        ),
    )


_M = TypeVar("_M", bound=BaseModel)


def _read(path: Path, model: type[_M]) -> _M:
    try:
        return model.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}; is this a recorded episode?") from error
    except ValidationError as error:
        raise InputError(f"{path} is not what an episode's recorder writes: {_first(error)}") from error


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {first['msg']}" if where else first["msg"]


def _triple(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 6) for v in values)
    return x, y, z
