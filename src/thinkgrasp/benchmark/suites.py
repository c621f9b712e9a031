"""Suites of the benchmark: which instructions over which piles, and after how many attempts an episode ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.paper_cases import Layout, list_cases, load_case
from thinkgrasp.sim.scenes import PiledScene, published
from thinkgrasp.sim.tasks import STEP_LIMIT, TASKS, Suite
from thinkgrasp.sim.urdf import load_objects

FIRST_SEED = 1000
"""Of the suites' piles; those of lower seeds were seen while the system was being built."""
SUITES = {
    "clutter-v1": "the 10 instructions of the paper's clutter table, a new pile for every run, 15 attempts",
    "heavy-v1": "its 6 heavy tasks: 20 to 30 unseen objects, the goal partly or completely hidden, 50 attempts",
    "paper-clutter": "the published clutter layouts, with catalogue objects of the same kind (--cases DIR)",
    "paper-heavy": "the published heavy layouts (--cases DIR)",
}
_GROUP: dict[str, Suite] = {
    "clutter-v1": "clutter",
    "heavy-v1": "heavy",
    "paper-clutter": "clutter",
    "paper-heavy": "heavy",
}
ALIASES = {"clutter": "clutter-v1", "heavy": "heavy-v1"}


@dataclass(frozen=True)
class SuiteSource:
    """A suite, and where what it needs lies.

    Raises:
        ConfigError: No such suite, or cases or objects given to one that has its own, or no cases to one that has none.
    """

    name: str
    cases: Path | None = None
    """Folder of the published layouts, absolute."""
    objects: Path | None = None
    """Folder of the published objects, one folder each, named by their published ids, absolute; else stand-ins."""

    def __post_init__(self) -> None:
        if self.name not in SUITES:
            raise ConfigError(f"no suite {self.name!r}; allowed: {', '.join((*ALIASES, *SUITES))}")
        if self.is_published and self.cases is None:
            raise ConfigError(f"suite {self.name!r} reads the published layouts: add --cases DIR")
        if not self.is_published and (self.cases or self.objects):
            given = "--cases" if self.cases else "--objects"
            raise ConfigError(f"suite {self.name!r} makes its own piles of catalogue objects; leave out {given}")

    def __str__(self) -> str:
        folders = {"layouts": self.cases, "objects": self.objects}
        return ", ".join([self.name, *(f"{what} in {folder}" for what, folder in folders.items() if folder)])

    @property
    def is_published(self) -> bool:
        """Whether the piles are the published ones."""
        return self.name.startswith("paper-")

    @property
    def group(self) -> Suite:
        """Which of the paper's two tables it belongs to."""
        return _GROUP[self.name]


@dataclass(frozen=True)
class Case:
    """One instruction over seeded piles."""

    name: str
    instruction: str
    step_limit: int
    scene: Callable[[int], PiledScene] = field(compare=False)
    """Makes the pile of a seed; raises InputError where none comes out."""


def load_suite(source: SuiteSource) -> tuple[Case, ...]:
    """Return the cases of a suite.

    Raises:
        InputError: Layouts or objects cannot be read.
    """
    limit = STEP_LIMIT[source.group]
    if source.cases is None:
        chosen = [task for task in TASKS if task.suite == source.group]
        return tuple(Case(task.name, task.instruction, limit, task.scene) for task in chosen)
    own = {Path(obj.source).name: obj for obj in load_objects(source.objects)} if source.objects else {}
    layouts = [load_case(file) for file in list_cases(source.cases)]
    chosen = [_of_layout(layout, own) for layout in layouts]
    if own and not any(chosen):
        raise InputError(
            f"{source.objects}: no folder is named by a published id of {source.cases}, such as "
            f"{layouts[0].ids[0].rpartition('/')[2]!r}; found {', '.join(sorted(own))}"
        )
    return tuple(
        Case(layout.name, layout.instruction, limit, partial(_published, layout, objects))
        for layout, objects in zip(layouts, chosen, strict=True)
    )


def _published(layout: Layout, own: dict[str, SimObject], seed: int) -> PiledScene:
    return published(layout, seed=seed, own=own)


def _of_layout(layout: Layout, own: dict[str, SimObject]) -> dict[str, SimObject]:
    ids = {name for full in layout.ids for name in (full, full.rpartition("/")[2])}
    return {name: obj for name, obj in own.items() if name in ids}
