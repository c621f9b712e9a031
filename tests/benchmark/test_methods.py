from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import small_pile

from thinkgrasp.benchmark.baselines import BestScore, Forgetful, PlannedMark, RandomObject, WithoutGraph
from thinkgrasp.benchmark.chat import MODEL
from thinkgrasp.benchmark.methods import VARIANTS, Method, check_methods, parse_method, running
from thinkgrasp.config import PRESETS, StageConfig, to_json
from thinkgrasp.errors import ConfigError
from thinkgrasp.memory import Memory
from thinkgrasp.sim.oracle import TruthPerception, TruthPlanner
from thinkgrasp.testbed import CameraOptions, Session


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(small_pile(("pear", "mug", "banana")), CameraOptions(size_wh=(224, 224)))


def test_presets_are_methods():
    for name in ("offline", "no-vlm", "vlm"):
        assert parse_method(name) == Method(name, PRESETS[name])


def test_an_accuracy_names_an_emulated_model():
    method = parse_method("vlm-paper@0.8")
    assert (method.name, method.accuracy) == ("vlm-paper@0.8", 0.8)
    assert method.config.planner.settings["model"] == MODEL


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("planner=mine", r"method 'planner=mine' cannot run here: no planner named 'mine'; installed: "),
        ("vlm", r"method 'vlm' cannot run here: .*OPENAI_API_KEY is not set"),
        ("learned", r"method 'learned' cannot run here: "),
    ],
)
def test_what_cannot_be_made_is_found_before_anything_runs(monkeypatch, name, says):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    check_methods(map(parse_method, ("offline", "vlm@0.8", "vlm-paper@1+truth", *VARIANTS)))
    with pytest.raises(ConfigError, match=says):
        check_methods([parse_method("offline"), parse_method(name)])


def test_a_plug_in_is_one_more_name():
    assert parse_method("generator=mine").config.generator == StageConfig("mine")
    assert parse_method("planner=mine").config.segmenter == PRESETS["offline"].segmenter


def test_a_saved_configuration_is_a_method(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(to_json(PRESETS["no-vlm"]))
    assert parse_method(str(path)).config == PRESETS["no-vlm"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ofline", "did you mean 'offline'"),
        ("", "no preset ''"),
        ("offline@0.5", "offline asks no model, so that @0.5 means nothing"),
        ("vlm@", "after @ stands how often"),
        ("vlm@1.5", "after @ stands how often"),
        ("vlm@nan", "after @ stands how often"),
        ("vlm@often", "after @ stands how often"),
        ("offline+lies", r"after \+ may stand 'truth', got 'lies'"),
        ("oracle+truth", "it knows the truth already"),
        ("planner=", "no preset 'planner='"),
        ("wheel=mine", "no preset 'wheel=mine'"),
    ],
)
def test_what_is_no_method_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_method(text)


@pytest.mark.parametrize("name", [*VARIANTS, "offline+truth", "no-graph+truth", "vlm@1", "no-vlm"])
def test_every_method_decides(session, name):
    with running(parse_method(name), session, "pear", 0) as pipeline:
        decision = pipeline.decide(session.cameras[0].read(), "give me the pear", Memory())
    assert decision.status == "grasp"
    assert any("oracle" in word for word in decision.plan.rationale.split("[")) == (name == "oracle")


def test_variants_take_away_what_they_say(session):
    def made(name):
        with running(parse_method(name), session, "pear", 0) as pipeline:
            return pipeline

    assert isinstance(made("no-memory"), Forgetful)
    assert isinstance(made("no-graph").scene, WithoutGraph)
    assert isinstance(made("best-score"), BestScore)
    random = made("random-object")
    assert isinstance(random.planner, RandomObject)
    assert isinstance(random.segmenter, PlannedMark)
    assert random.n_nearest > 1000
    assert made("nearest-grasp").n_nearest == 1
    assert isinstance(made("oracle").planner, TruthPlanner)
    assert isinstance(made("offline+truth").scene, TruthPerception)
    assert not isinstance(made("offline").scene, TruthPerception)
