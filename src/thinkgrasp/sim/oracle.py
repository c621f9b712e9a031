"""The `oracle` preset: names and masks from the simulator's truth, the upper bound for what perception can gain.

Geometry stays what the camera measured, noise included; only what a thing is, and which pixels are its, is looked up.
The pipeline's own stages never import this module; whoever runs it says so in every output.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from thinkgrasp.config import PipelineConfig, StageConfig, make_pipeline, override
from thinkgrasp.errors import ConfigError
from thinkgrasp.interfaces import ScenePerception
from thinkgrasp.language.grounding import Grounding, Match
from thinkgrasp.language.query import parse
from thinkgrasp.language.wanted import Query
from thinkgrasp.memory import Memory
from thinkgrasp.perception.geometric import GeometricPerception
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.planners.offline import OfflinePlanner
from thinkgrasp.segmenters.geometric import GeometricSegmenter
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Plan, Scene, Segmentation

ORACLE = "oracle"
"""The preset's name."""


class TruthPerception(ScenePerception):
    """Tells things apart by the simulator's truth; measures them in the frame.

    The world must be as it was when the frame was taken.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._geometry = GeometricPerception()
        self._objects: dict[int, int] = {}
        self._scene: Scene | None = None

    def perceive(self, frame: Frame) -> Scene:
        """Return the scene with one proposal per object in view."""
        if frame.T_world_camera is None:
            raise ConfigError("the oracle preset needs frames of the simulated camera: T_world_camera is missing")
        labels = true_labels(self._world, CameraView(frame.camera, frame.T_world_camera)) + 1
        if frame.workspace is not None:
            labels = np.where(frame.workspace, labels, 0).astype(np.int32)
        scene = self._geometry.perceive(frame, labels)
        self._objects = {p.mark: int(np.bincount(labels[p.mask]).argmax()) - 1 for p in scene.proposals}
        self._scene = scene
        return scene

    def object_of(self, scene: Scene, mark: int) -> int:
        """Return the index of the object behind a mark of the scene perceived last; -1 = none."""
        if scene is not self._scene:
            raise ConfigError("the oracle knows only the scene that it perceived last")
        return self._objects[mark]


class TruthPlanner:
    """The offline planner with the names of things known instead of guessed."""

    def __init__(self, world: World, perception: TruthPerception, goals: Collection[int], *, grid: int = 3) -> None:
        self._world = world
        self._perception = perception
        self._goals = frozenset(goals)
        self._planner = OfflinePlanner(grid=grid, search="all", ground=self._ground)

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Choose as the offline planner does; the rationale says whose knowledge it is."""
        if not parse(instruction).understood:
            instruction = "anything"
        plan = self._planner.plan(scene, instruction, memory)
        return replace(plan, rationale=f"[oracle: names and masks are the simulator's truth] {plan.rationale}")

    def _ground(self, scene: Scene, query: Query) -> Grounding:
        matches: list[Match] = []
        for p in scene.proposals:
            index = self._perception.object_of(scene, p.mark)
            name = self._world.objects[index].name if index >= 0 else "thing"
            is_goal = index in self._goals
            reason = "it is a goal" if is_goal else "it is no goal"
            matches.append(Match(p.mark, float(is_goal), name, (reason,), name))
        return Grounding(tuple(sorted(matches, key=lambda m: (-m.score, m.mark))), names_are_known=True)


class TruthSegmenter:
    """The planned proposal alone."""

    def __init__(self) -> None:
        self._segmenter = GeometricSegmenter()

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return the mask of the planned mark."""
        return self._segmenter.segment(scene, replace(plan, role="obstruction"))


def oracle_pipeline(config: PipelineConfig, world: World, goals: Collection[int]) -> Pipeline:
    """Return the pipeline of a configuration with perception, planner and segmenter replaced by the truth."""
    pipeline = make_pipeline(override(config, "scene", StageConfig("geometric")))
    perception = TruthPerception(world)
    pipeline.scene = perception
    pipeline.planner = TruthPlanner(world, perception, goals)
    pipeline.segmenter = TruthSegmenter()
    return pipeline
