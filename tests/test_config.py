"""Presets, overrides and saved configurations."""

from __future__ import annotations

import json

import pytest

from thinkgrasp.config import (
    PRESET_NOTES,
    PRESETS,
    PipelineConfig,
    StageConfig,
    from_json,
    load_config,
    make_pipeline,
    override,
    parse_assignment,
    to_json,
)
from thinkgrasp.errors import ConfigError
from thinkgrasp.gripper import GRIPPERS, Gripper

SMALL = Gripper("small", 0.05, 0.04, 0.01, 0.02, (0.1, 0.06, 0.05), 0.03)
OFFLINE = PRESETS["offline"]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_json(name):
    assert from_json(to_json(PRESETS[name])) == PRESETS[name]


def test_changed_configuration_survives_json():
    config = override(OFFLINE, "planner.grid", 4)
    config = override(config, "scene", None)
    config = override(config, "gripper", SMALL)
    config = override(config, "checks", ["width", StageConfig("collision", {"voxel_m": 0.002})])
    config = override(override(config, "seed", 7), "n_nearest", 3)
    again = from_json(to_json(config))
    assert again == config
    assert (again.gripper, again.scene, again.seed, again.n_nearest) == (SMALL, None, 7, 3)


def test_every_preset_is_described():
    assert set(PRESET_NOTES) == set(PRESETS)


def test_overriding_leaves_the_preset_alone():
    before = to_json(OFFLINE)
    changed = override(OFFLINE, "planner.grid", 4)
    assert changed.planner.settings == {"grid": 4}
    assert to_json(OFFLINE) == before


def test_a_check_can_be_set():
    config = override(OFFLINE, "checks.collision.voxel_m", 0.002)
    assert {c.name: c.settings for c in config.checks}["collision"] == {"voxel_m": 0.002}
    assert [c.name for c in config.checks] == [c.name for c in OFFLINE.checks]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("plannr", "x", "no configuration key 'plannr'; did you mean 'planner'"),
        ("zzz", 1, "allowed: scene, planner"),
        ("planner", None, "planner must be a plug-in name"),
        ("planner", "", "planner must be a plug-in name"),
        ("planner", 3, "planner must be a plug-in name"),
        ("planner", {"nam": "x"}, "planner must be a plug-in name"),
        ("checks", "width", "checks must be a list"),
        ("checks", 3, "checks must be a list"),
        ("checks", ["width", "width"], "each check may occur once"),
        ("checks.collsion.voxel_m", 1, "did you mean 'collision'"),
        ("checks.collision", 1, "must be checks.<name>.<setting>"),
        ("seed.x", 1, "seed has no settings"),
        ("seed", -1, "seed must be a whole number of at least 0, got -1"),
        ("seed", 1.5, "seed must be a whole number"),
        ("seed", True, "seed must be a whole number"),
        ("n_nearest", 0, "n_nearest must be a whole number of at least 1"),
        ("gripper", 3, "gripper must be a name"),
    ],
)
def test_impossible_overrides(key, value, message):
    with pytest.raises(ConfigError, match=message):
        override(OFFLINE, key, value)


def test_settings_of_a_stage_that_is_off():
    strict = override(OFFLINE, "scene", None)
    with pytest.raises(ConfigError, match="has no scene stage"):
        override(strict, "scene.x", 1)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("planner.grid=4", ("planner.grid", 4)),
        ("a=0.5", ("a", 0.5)),
        ("a=true", ("a", True)),
        ("a=null", ("a", None)),
        ("a=[1, 2]", ("a", [1, 2])),
        ("a=plain text", ("a", "plain text")),
        ("a=x=y", ("a", "x=y")),
        ("a=", ("a", "")),
    ],
)
def test_assignments(text, expected):
    assert parse_assignment(text) == expected


@pytest.mark.parametrize("text", ["", "a", "=3", " =3"])
def test_no_assignment(text):
    with pytest.raises(ConfigError, match="KEY=VALUE"):
        parse_assignment(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not readable as JSON"),
        ("[" * 100_000, "not readable as JSON"),
        ("[]", "must be a JSON object, got a list"),
        ("{}", "schema is None, this version reads 'thinkgrasp/config-1'"),
        ('{"schema": "thinkgrasp/config-9"}', "config-9"),
        ('{"schema": "thinkgrasp/config-1"}', "lacks planner, segmenter, generator, checks"),
        ('{"schema": "thinkgrasp/config-1", "planer": 1}', "did you mean 'planner'"),
    ],
)
def test_broken_json(text, message):
    with pytest.raises(ConfigError, match=message):
        from_json(text)


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("planner", None, "planner must be a plug-in name"),
        ("gripper", {"name": "x"}, "gripper: "),
        ("gripper", {"name": "x", "palm": 3}, "gripper: "),
        ("checks", {"name": "width"}, "checks must be"),
        ("seed", "1", "seed must be a whole number"),
    ],
)
def test_broken_entries(entry, value, message):
    with pytest.raises(ConfigError, match=message):
        from_json(json.dumps(json.loads(to_json(OFFLINE)) | {entry: value}))


class TestLoading:
    def test_preset(self):
        assert load_config("offline") is OFFLINE

    def test_file(self, tmp_path):
        (tmp_path / "mine.json").write_text(to_json(override(OFFLINE, "seed", 5)))
        assert load_config(tmp_path / "mine.json").seed == 5

    def test_wrong_name(self):
        with pytest.raises(ConfigError, match="no preset 'oflline'; did you mean 'offline'"):
            load_config("oflline")

    def test_missing_and_broken_file(self, tmp_path):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_config(tmp_path / "none.json")
        (tmp_path / "broken.json").write_text("{")
        with pytest.raises(ConfigError, match=r"broken.json: not readable as JSON"):
            load_config(tmp_path / "broken.json")


class TestMaking:
    def test_the_offline_preset(self):
        pipeline = make_pipeline("offline")
        assert list(pipeline.checks) == [c.name for c in OFFLINE.checks]
        assert pipeline.gripper is GRIPPERS["robotiq_2f85"]

    def test_overrides(self):
        pipeline = make_pipeline(gripper=SMALL, seed=3, n_nearest=4, scene=None, checks=["width"])
        assert (pipeline.gripper, pipeline.seed, pipeline.n_nearest, pipeline.scene) == (SMALL, 3, 4, None)
        assert list(pipeline.checks) == ["width"]

    def test_unknown_setting_of_a_stage(self):
        with pytest.raises(ConfigError, match="planner 'offline' does not take the settings"):
            make_pipeline(**{"planner.grdi": 4})

    def test_unknown_gripper(self):
        with pytest.raises(ConfigError, match="no gripper 'tweezers': built-in are"):
            make_pipeline(gripper="tweezers")


def test_a_value_that_json_cannot_hold():
    with pytest.raises(ConfigError, match="JSON cannot"):
        to_json(override(OFFLINE, "planner.model", object()))


def test_config_is_comparable():
    assert PipelineConfig(StageConfig("a"), StageConfig("b"), StageConfig("c"), ()) == PipelineConfig(
        StageConfig("a"), StageConfig("b"), StageConfig("c"), ()
    )
