"""Every plug-in that is registered, ours or another package's, keeps its contract."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from thinkgrasp import registry, testing
from thinkgrasp.cameras.saving import save_frame

STAGES = {
    "scene": testing.check_scene,
    "planner": testing.check_planner,
    "segmenter": testing.check_segmenter,
    "generator": testing.check_generator,
    "check": testing.check_check,
}


def registered(kind: registry.Kind) -> list[str]:
    return list(registry.available(kind))


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in STAGES for name in registered(kind)])
def test_stage_keeps_its_contract(kind, name):
    STAGES[kind](registry.load(kind, name))


def test_file_camera_keeps_its_contract(tmp_path):
    color, depth, camera = save_frame(testing.sample_frame(), tmp_path)
    testing.check_camera(registry.load("camera", "files", color=color, depth=depth, camera=camera))


def test_no_kind_is_left_out():
    untested = set(registry.KINDS) - set(STAGES) - {"camera"}
    assert all(not registered(kind) for kind in untested), "a kind has plug-ins, but no contract test here"


def test_each_preset_names_registered_plugins():
    from thinkgrasp.config import PRESETS, STAGES

    for config in PRESETS.values():
        for kind in STAGES:
            stage = getattr(config, kind)
            assert stage is None or isinstance(registry.available(kind)[stage.name], EntryPoint)
        assert {c.name for c in config.checks} <= set(registry.available("check"))
