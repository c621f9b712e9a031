"""The presets paper-sim and paper-real from files to a decision, and how they do without a key."""

from __future__ import annotations

import json

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from fakes.grasp_networks import random_weights, save  # noqa: E402

from thinkgrasp.cameras.saving import save_frame  # noqa: E402
from thinkgrasp.config import PRESETS, from_json, make_pipeline, to_json  # noqa: E402
from thinkgrasp.errors import ConfigError  # noqa: E402
from thinkgrasp.testing import sample_frame  # noqa: E402

NETWORKS = {"paper-sim": "graspnet", "paper-real": "fgc"}
FEWER_POINTS = ("--set", "generator.num_point=4000", "--set", "generator.device=cpu")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    color, depth, camera = save_frame(sample_frame(), folder)
    weights = {preset: save(folder / f"{preset}.tar", random_weights(net)) for preset, net in NETWORKS.items()}
    return (str(color), str(depth), "the red box", "--camera", str(camera)), weights


@pytest.fixture(autouse=True)
def no_key(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)


@pytest.mark.parametrize("preset", NETWORKS)
def test_end_to_end_without_a_key(preset, files, cli):
    command, weights = files
    result = cli("grasp", *command, "--preset", preset, "--weights", str(weights[preset]), *FEWER_POINTS, "--json")
    assert result.code in (0, 1), result.err
    decision = json.loads(result.out)
    assert decision["status"] in ("grasp", "no_grasp")
    steps = [step["check"] for step in decision["funnel"]]
    assert steps == ["candidates", "target", "width", "workspace", "model_free_collision", "nms"]
    assert decision["funnel"][0]["out"] > 0
    (note,) = [d for d in decision["degraded"] if d["stage"] == "plan"]
    assert "OPENAI_API_KEY" in note["reason"]
    assert note["fallback"] == "the offline planner"


@pytest.mark.parametrize("preset", NETWORKS)
def test_without_weights_the_command_line_says_what_to_do(preset, files, cli):
    command, _ = files
    result = cli("grasp", *command, "--preset", preset)
    assert result.code == 2
    assert "--weights FILE" in result.err
    assert "non-commercial" in result.err
    assert result.err.count("\n") == 1


def test_weights_for_a_generator_without_a_network_are_refused(files, cli):
    command, weights = files
    result = cli("grasp", *command, "--weights", str(weights["paper-sim"]))
    assert result.code == 2
    assert "does not take the settings ['weights']" in result.err


def test_the_presets_differ_in_generator_and_picture_alone():
    sim, real = PRESETS["paper-sim"], PRESETS["paper-real"]
    assert (sim.generator.name, real.generator.name) == ("graspnet", "fgc_graspnet")
    assert (sim.segmenter, sim.checks, sim.scene) == (real.segmenter, real.checks, real.scene)
    assert sim.planner.with_setting("image_width", 640) == real.planner
    assert from_json(to_json(sim)) == sim


def test_a_key_that_is_set_is_used(files, monkeypatch):
    pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")
    _, weights = files
    overrides = {"generator.weights": str(weights["paper-sim"]), "generator.device": "cpu"}
    monkeypatch.setenv("OPENAI_API_KEY", "two words")
    with pytest.raises(ConfigError, match="must hold one API key"):
        make_pipeline("paper-sim", **overrides)
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(ConfigError, match="key_file"):
        make_pipeline("paper-sim", **overrides, **{"planner.key_file": "/nowhere"})
    with pytest.raises(ConfigError, match="not the key itself") as error:
        make_pipeline("paper-sim", **overrides, **{"planner.key_env": "sk-secret"})
    assert "sk-secret" not in str(error.value)
    with pytest.raises(ConfigError, match="without_key must be"):
        make_pipeline("paper-sim", **overrides, **{"planner.without_key": "never"})
    with pytest.raises(ConfigError, match="OPENAI_API_KEY is not set"):
        make_pipeline("paper-sim", **overrides, **{"planner.without_key": "error"})
