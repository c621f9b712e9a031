from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import VIEW, look, small_pile

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.config import load_config
from thinkgrasp.errors import ConfigError
from thinkgrasp.language.query import parse
from thinkgrasp.memory import Memory
from thinkgrasp.sim.oracle import TruthPerception, TruthPlanner, TruthSegmenter, oracle_pipeline
from thinkgrasp.sim.tabletop import pose
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.sim.world import World
from thinkgrasp.types import Scene

NAMES = ("pear", "mug", "banana", "scissors")


@pytest.fixture(scope="module")
def world() -> World:
    """Four things, the last across the edge of the workspace."""
    pile = small_pile(NAMES)
    world = World(pile.spec.objects)
    for index, T in enumerate(pile.poses):
        world.place(index, T)
    world.place(3, pose(0.22, -0.10, 0.01))
    world.settle()
    return world


@pytest.fixture(scope="module")
def perception(world: World) -> TruthPerception:
    return TruthPerception(world)


@pytest.fixture(scope="module")
def scene(world: World, perception: TruthPerception) -> Scene:
    return perception.perceive(look(world))


def test_proposals_are_the_true_masks_inside_the_workspace(world, perception, scene):
    labels = true_labels(world, VIEW)
    seen = scene.frame.workspace & np.isfinite(scene.points[..., 2])
    assert [p.mark for p in scene.proposals] == [1, 2, 3, 4]
    found = [perception.object_of(scene, p.mark) for p in scene.proposals]
    assert sorted(found) == [0, 1, 2, 3]
    for proposal, index in zip(scene.proposals, found, strict=True):
        np.testing.assert_array_equal(proposal.mask, (labels == index) & seen)
    cut = scene.proposal(found.index(3) + 1)
    assert 0 < cut.mask.sum() < (labels == 3).sum()


def test_geometry_is_measured_not_known(world):
    camera = SimulatedCamera(world, VIEW, seed=5)
    exact, noisy = TruthPerception(world).perceive(look(world)), TruthPerception(world).perceive(camera.read())
    assert not np.array_equal(exact.points, noisy.points, equal_nan=True)
    assert exact.proposals[0].extents_m != noisy.proposals[0].extents_m


@pytest.mark.parametrize("goal", range(3))
def test_names_are_true_and_whose_knowledge_it_is_is_said(world, perception, scene, goal):
    instruction = f"give me the {NAMES[goal]}"
    planner = TruthPlanner(world, perception, {goal})
    plan = planner.plan(scene, instruction, Memory())
    assert plan.found
    assert plan.rationale.startswith("[oracle: names and masks are the simulator's truth]")
    assert (plan.target, plan.role) == (NAMES[goal], "goal")
    assert perception.object_of(scene, plan.mark) == goal
    for match in planner._ground(scene, parse(instruction)).matches:
        index = perception.object_of(scene, match.mark)
        assert (match.name, match.score) == (NAMES[index], float(index == goal))
    segments = TruthSegmenter().segment(scene, plan).segments
    assert len(segments) == 1
    np.testing.assert_array_equal(segments[0].mask, scene.proposal(plan.mark).mask)


def test_goals_are_what_the_referee_says_not_what_the_words_say(world, perception, scene):
    plan = TruthPlanner(world, perception, {1}).plan(scene, "bring me the qwertzuiop", Memory())
    assert perception.object_of(scene, plan.mark) == 1


def test_without_a_goal_in_view_it_goes_on_clearing(world, perception, scene):
    plan = TruthPlanner(world, perception, {99}).plan(scene, "give me the pear", Memory())
    assert plan.role == "obstruction"
    assert plan.found


def test_it_knows_only_the_scene_perceived_last(world, perception, scene):
    with pytest.raises(ConfigError, match="last"):
        perception.object_of(replace(scene), 1)


def test_a_frame_without_pose_is_refused(world):
    with pytest.raises(ConfigError, match="T_world_camera"):
        TruthPerception(world).perceive(replace(look(world), T_world_camera=None))


def test_the_pipeline_keeps_everything_but_what_truth_replaces(world):
    config = load_config("offline")
    pipeline = oracle_pipeline(config, world, {0})
    assert isinstance(pipeline.scene, TruthPerception)
    assert isinstance(pipeline.planner, TruthPlanner)
    assert list(pipeline.checks) == [c.name for c in config.checks]
    assert "truth" not in type(pipeline.generator).__name__.lower()
