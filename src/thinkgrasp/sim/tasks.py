"""Named tasks: the instructions of the published benchmark over seeded piles, and piles for any other instruction."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from thinkgrasp.errors import ConfigError
from thinkgrasp.sim import scenes
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.scenes import PiledScene, Visibility

Suite = Literal["clutter", "heavy"]

STEP_LIMIT: dict[Suite, int] = {"clutter": 15, "heavy": 50}
N_OWN_CLUTTER = 10
"""Catalogue objects around an object of one's own, or around the goal of a free instruction."""


@dataclass(frozen=True)
class Task:
    """One instruction over seeded piles."""

    name: str
    """Suite, number and key word: "clutter-06-fruit"."""
    suite: Suite
    instruction: str
    n_goals: int
    """How many objects of the pile serve the instruction."""
    visibility: Visibility | None = None
    """Of every goal; None = as it falls."""

    @property
    def step_limit(self) -> int:
        """Attempts after which an episode ends."""
        return STEP_LIMIT[self.suite]

    @property
    def n_objects(self) -> tuple[int, int]:
        """Fewest and most objects of a pile."""
        return scenes.CLUTTER_OBJECTS if self.suite == "clutter" else scenes.HEAVY_OBJECTS

    def scene(self, seed: int, visibility: Visibility | None = None) -> PiledScene:
        """Make a pile.

        Args:
            seed: The same seed gives the same pile.
            visibility: Instead of the task's own.

        Raises:
            InputError: No pile came out as asked for.
            ConfigError: The seed is negative.
        """
        make = scenes.clutter if self.suite == "clutter" else scenes.heavy
        return make(self.instruction, seed, n_goals=self.n_goals, visibility=visibility or self.visibility)


TASKS: tuple[Task, ...] = (
    Task("clutter-00-round", "clutter", "grasp a round object", 2),
    Task("clutter-01-eat", "clutter", "get something to eat", 3),
    Task("clutter-02-container", "clutter", "get something to hold other things", 1),
    Task("clutter-03-round2", "clutter", "I want a round object", 2),
    Task("clutter-04-cup", "clutter", "give me the cup", 1),
    Task("clutter-05-cup2", "clutter", "I need a cup", 1),
    Task("clutter-06-fruit", "clutter", "I need a fruit", 3),
    Task("clutter-07-drink", "clutter", "get something to drink", 1),
    Task("clutter-08-thera_med", "clutter", "give me the thera_med", 1),
    Task("clutter-09-pear", "clutter", "give me the pear", 1),
    Task("heavy-00-round", "heavy", "grasp a ball", 1, "partly"),
    Task("heavy-01-round_hard", "heavy", "grasp a ball", 1, "hidden"),
    Task("heavy-02-container", "heavy", "get something to hold other things", 1, "partly"),
    Task("heavy-03-container_hard", "heavy", "get something to hold other things", 1, "hidden"),
    Task("heavy-04-fruit", "heavy", "I need a fruit", 1, "partly"),
    Task("heavy-05-fruit_hard", "heavy", "I need a fruit", 1, "hidden"),
)
"""Instructions, numbers of goals and order are those of the published cases."""


def find_task(name: str) -> Task:
    """Return a task by its name or a unique ending of it: "heavy-04-fruit", "00-round" is two, "pear" is one.

    Raises:
        ConfigError: No such task, or several; the message lists them.
    """
    for task in TASKS:
        if task.name == name:
            return task
    ending = [task for task in TASKS if task.name.endswith(f"-{name}")]
    if len(ending) == 1:
        return ending[0]
    names = [task.name for task in TASKS]
    if ending:
        raise ConfigError(f"{name!r} may be {' or '.join(task.name for task in ending)}; say which")
    close = difflib.get_close_matches(name, [*names, *(n.split("-", 2)[2] for n in names)], n=1)
    hint = f"Did you mean {close[0]!r}? " if close else ""
    raise ConfigError(f"no task {name!r}. {hint}Tasks are {', '.join(names)}")


def task_for(
    instruction: str, seed: int, own: Sequence[SimObject] = (), visibility: Visibility | None = None
) -> PiledScene:
    """Make a pile for a free instruction: one object that serves it among ten catalogue objects that do not.

    Args:
        instruction: For example "I need a fruit" or "the scissors".
        seed: The same seed gives the same pile.
        own: Where given, the goal is one of these; catalogue objects that would answer as well are kept out.
        visibility: Of the goal; None = as it falls.

    Raises:
        InputError: The instruction names none of `own`, or nothing of the catalogue; the message lists what there is.
        ConfigError: The seed is negative.
    """
    return scenes.clutter(instruction, seed, n_objects=N_OWN_CLUTTER + 1, visibility=visibility, pool="all", own=own)
