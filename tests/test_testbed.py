from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import small_pile  # noqa: E402

from thinkgrasp.config import StageConfig, load_config  # noqa: E402
from thinkgrasp.pipeline import Pipeline  # noqa: E402
from thinkgrasp.sim.objects import SimObject  # noqa: E402
from thinkgrasp.sim.scenes import PiledScene  # noqa: E402
from thinkgrasp.sim.world import World  # noqa: E402
from thinkgrasp.testbed import CameraOptions, Session, SimulatedEpisode, for_the_loop  # noqa: E402

SMALL = CameraOptions(size_wh=(224, 224))


@pytest.fixture(scope="module")
def pile() -> PiledScene:
    return small_pile(("pear", "mug", "banana"))


@pytest.fixture(scope="module", params=["oracle", "offline"])
def finished(request: pytest.FixtureRequest, pile: PiledScene) -> tuple[str, Session, Pipeline, SimulatedEpisode]:
    session = Session(pile, SMALL, seed=3)
    pipeline = session.pipeline(request.param)
    return request.param, session, pipeline, session.run(pipeline, step_limit=5)


def test_an_episode_ends_with_the_goal_in_the_bin(finished):
    preset, session, _, result = finished
    assert result.episode.end == "goal_delivered"
    assert session.goal_delivered()
    assert result.goals == session.goals == (0,)
    last = result.attempts[-1]
    assert (last.outcome.reason, last.truth.delivered) == ("held", 0)
    assert len(result.attempts) == result.episode.attempts
    assert last.moved_out == ()
    for step in result.episode.steps:
        assert ("[oracle:" in step.decision.plan.rationale) == (preset == "oracle")


def test_the_same_seed_gives_the_same_bits(pile, finished):
    preset, session, _, first = finished
    again = Session(pile, SMALL, seed=3)
    second = again.run(again.pipeline(preset), step_limit=5)
    assert [a.outcome for a in first.attempts] == [a.outcome for a in second.attempts]
    assert [a.truth for a in first.attempts] == [a.truth for a in second.attempts]
    np.testing.assert_array_equal(session.world.data.qpos, again.world.data.qpos)
    for one, other in zip(first.episode.steps, second.episode.steps, strict=True):
        a, b = one.decision, other.decision
        np.testing.assert_array_equal(a.scene.frame.depth, b.scene.frame.depth)
        assert (a.status, a.plan, a.funnel) == (b.status, b.plan, b.funnel)
        np.testing.assert_array_equal(a.grasp.rotation, b.grasp.rotation)
        np.testing.assert_array_equal(a.grasp.position, b.grasp.position)
        assert a.grasp.width_m == b.grasp.width_m


def test_another_seed_sees_other_noise(pile):
    depths = [Session(pile, SMALL, seed=seed).cameras[i].read().depth for seed in (0, 1) for i in (0, 1)]
    assert not np.array_equal(depths[0], depths[2])
    exact = Session(pile, replace(SMALL, noise=False)).cameras[0].read().depth
    assert not np.array_equal(depths[0], exact)


def test_the_pile_stands_as_it_was_made(pile):
    np.testing.assert_allclose(Session(pile, SMALL).world.poses(), pile.poses, atol=2e-3)


def test_someone_may_watch(pile):
    session = Session(pile, SMALL, seed=3)
    seen: list[float] = []
    session.watch(lambda: seen.append(session.world.time_s))
    session.run(session.pipeline("oracle"), step_limit=1)
    assert len(seen) > 20


# -- no truth behind the pipeline's back -----------------------------------------------------------------------------


def reachable(root: object) -> Iterator[object]:
    """Everything that can be got at from an object by attributes, items, closures, defaults and bound methods."""
    stack, seen = [root], set[int]()
    while stack:
        item = stack.pop()
        if id(item) in seen or isinstance(item, (ModuleType, type, str, bytes, int, float, complex)):
            continue
        seen.add(id(item))
        yield item
        if isinstance(item, dict):
            stack += [*item.keys(), *item.values()]
        elif isinstance(item, (list, tuple, set, frozenset)):
            stack += item
        elif isinstance(item, FunctionType):
            stack += [c.cell_contents for c in item.__closure__ or ()] + list(item.__defaults__ or ())
            stack += (item.__kwdefaults__ or {}).values()
        elif isinstance(item, (MethodType, BuiltinFunctionType)):
            stack.append(item.__self__)
        elif isinstance(item, np.ndarray):
            stack += [item.base, *(item.ravel() if item.dtype == object else ())]
        stack += getattr(item, "__dict__", {}).values()
        for kind in type(item).__mro__:
            stack += [getattr(item, slot, None) for slot in getattr(kind, "__slots__", ())]
        for name in ("func", "args", "keywords"):  # functools.partial
            stack.append(getattr(item, name, None))


def truth_behind(root: object, world: World) -> set[str]:
    """Names of the types of what the simulator knows and `root` could ask."""
    mine = {id(world), id(world.data), id(world.model)}
    return {
        type(item).__name__
        for item in reachable(root)
        if id(item) in mine
        or isinstance(item, (World, SimObject, PiledScene))
        or (isinstance(item, np.ndarray) and np.shares_memory(item, world.data.qpos))
    }


def test_the_perceiving_pipeline_cannot_ask_the_simulator(finished):
    preset, session, pipeline, _ = finished
    found = truth_behind(pipeline, session.world)
    if preset == "oracle":
        assert {"World", "SimObject"} <= found  # the walk would find it
    else:
        assert found == set()
        models = [m for m in reachable(pipeline) if isinstance(m, mujoco.MjModel)]
        assert models  # the planner's own model of the arm
        for model in models:
            assert not any(model.body(b).name.startswith("object_") for b in range(model.nbody))


def test_no_frame_nor_decision_carries_truth(finished):
    _, session, _, result = finished
    for camera in session.cameras:
        assert truth_behind(camera.read(), session.world) == set()
    for step in result.episode.steps:
        assert truth_behind(step.decision, session.world) == set()


# -- configuration ---------------------------------------------------------------------------------------------------


def test_for_the_loop_adds_what_the_loop_needs():
    config = for_the_loop(load_config("offline"))
    names = [c.name for c in config.checks]
    assert names.count("reach") == 1
    assert config.planner.settings["search"] == "all"
    assert config.generator.settings["tip_height_m"] == 0.0035
    collision = config.checks[names.index("collision")]
    assert collision.settings["support_noise_m"] == 0.003
    assert for_the_loop(config) == config


@pytest.mark.parametrize("preset", ["offline", "learned"])
def test_for_the_loop_lets_fingers_come_near_the_table(preset):
    assert for_the_loop(load_config(preset)).generator.settings["tip_height_m"] == 0.0035


def test_for_the_loop_keeps_settings_that_were_made():
    made = load_config("offline")
    checks = [c.with_setting("support_noise_m", 0.001) if c.name == "collision" else c for c in made.checks]
    reach = StageConfig("reach").with_setting("max_kept", 7)
    made = replace(
        made,
        planner=made.planner.with_setting("search", "none"),
        generator=made.generator.with_setting("tip_height_m", 0.01),
        checks=(*checks, reach),
    )
    assert for_the_loop(made) == made


def test_for_the_loop_leaves_other_stages_alone():
    made = replace(load_config("offline"), planner=StageConfig("mine"), generator=StageConfig("mine"))
    config = for_the_loop(made)
    assert (config.planner, config.generator) == (made.planner, made.generator)
