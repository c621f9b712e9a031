"""The command with a planner that asks a model, on real sockets: every fault ends in a decision that says so.

The scene is the rendered table top, so that the offline planner finds "the red box" where the model is of no use.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import pytest
from fakes.chat_server import Step, dead_url, error, good, serving

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.schema import DecisionModel
from thinkgrasp.testing import sample_frame

pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")

KEY = "canary-b1946ac92492"
REPLY = {
    "rationale": "red",
    "visible": True,
    "target": "red box",
    "mark": 1,
    "role": "goal",
    "kind": "object",
    "cell": 5,
}
GOOD = good(REPLY | {"objects": []})
PAPER = good(
    "Goal visible: yes\nSelected object: red box\nCropping box: (60, 60, 120, 130)\nObjects:\n"
    "- red box: grasp score 80, preferred cell 1"
)
RETRY = {"Retry_After": "0.01"}


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[str, str, str]:
    color, depth, camera = save_frame(sample_frame(), tmp_path_factory.mktemp("frame"))
    return str(color), str(depth), str(camera)


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEST_KEY", KEY)


def asking(files: tuple[str, str, str], url: str, *more: str, preset: str = "vlm") -> list[str]:
    color, depth, camera = files
    settings = (f"planner.base_url={url}", "planner.key_env=TEST_KEY")
    sets = [word for setting in settings for word in ("--set", setting)]
    return ["grasp", color, depth, "the red box", "--camera", camera, "--json", "--preset", preset, *sets, *more]


FAULTS: dict[str, tuple[tuple[Step, ...], str]] = {
    "429 twice, then good": ((error(429, "slow down", **RETRY), error(429, "slow down", **RETRY), GOOD), "asked again"),
    "500 five times": ((error(500, **RETRY),) * 5, "the offline planner"),
    "hang": ((Step(hang=True),), "the offline planner"),
    "half a JSON": ((Step(body=GOOD.body[:60]), GOOD), "asked again"),
    "half a JSON every time": ((Step(body=GOOD.body[:60]),), "the offline planner"),
    "refusal": ((good(None, refusal="I cannot help with that."),), "the offline planner"),
    "refusal in words": ((good("I'm sorry, but I can't help with that."),), "the offline planner"),
    "10 MB": ((good("x" * 10_000_000),), "the offline planner"),
    "wrong content type": ((Step(body=b"<html>hi</html>", headers={"Content-Type": "text/html"}),), "offline planner"),
    "wrong mark, then good": ((good(REPLY | {"mark": 99}), GOOD), "asked to mend it"),
    "wrong mark every time": ((good(REPLY | {"mark": 99}),), "the offline planner"),
    "wrong key": ((error(401, f"Incorrect API key provided: {KEY}"),), "the offline planner"),
    "the key in the reply": ((good(f"your key is {KEY}"),), "the offline planner"),
    "connection cut": ((replace(GOOD, cut_at=30), GOOD), "asked again"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_in_a_decision_that_says_what_happened(fault, cli, files, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    steps, fallback = FAULTS[fault]
    cassette = tmp_path / "cassette.jsonl"
    limit = "planner.decision_timeout_s=" + ("0.5" if fault == "hang" else "20")
    more = ("--record", str(cassette), "--set", "planner.retries=2", "--set", limit)
    with serving(*steps) as server:
        result = cli(*asking(files, server.url, *more))
    model = DecisionModel.model_validate_json(result.out)
    assert (result.code, model.status) == (0, "grasp")
    assert fallback in "; ".join(d.fallback for d in model.degraded if d.stage == "plan")
    assert model.usage.requests == len(server.requests) > 0
    assert all(r.headers["authorization"] == f"Bearer {KEY}" for r in server.requests)
    assert KEY not in result.out + result.err + caplog.text + cassette.read_text()


def test_nobody_listens(cli, files, tmp_path):
    result = cli(*asking(files, dead_url(), "--record", str(tmp_path / "cassette.jsonl"), "--set", "planner.retries=0"))
    model = DecisionModel.model_validate_json(result.out)
    assert (result.code, model.status) == (0, "grasp")
    assert "cannot be reached" in model.degraded[0].reason


def test_what_was_recorded_is_replayed_without_a_server_or_a_key(cli, files, tmp_path, monkeypatch):
    cassette = tmp_path / "cassette.jsonl"
    with serving(error(429, **RETRY), GOOD) as server:
        recorded = json.loads(cli(*asking(files, server.url, "--record", str(cassette))).out)
    monkeypatch.delenv("TEST_KEY")
    replayed = json.loads(cli(*asking(files, dead_url(), "--replay", str(cassette))).out)
    assert replayed | {"timings_ms": {}} == recorded | {"timings_ms": {}}
    assert recorded["usage"]["requests"] == 2

    other = asking(files, dead_url(), "--replay", str(cassette), preset="vlm-paper")
    result = cli(*other)
    assert (result.code, result.out) == (2, "")
    assert "does not hold the request" in result.err
    assert "record it anew" in result.err


@pytest.mark.parametrize("option", ["--record", "--replay"])
@pytest.mark.parametrize("preset", ["offline", "no-vlm"])
def test_a_cassette_is_refused_where_no_model_is_asked(option, preset, cli, files, tmp_path):
    color, depth, camera = files
    args = ["grasp", color, depth, "the red box", "--camera", camera, "--preset", preset]
    result = cli(*args, option, str(tmp_path / "cassette.jsonl"))
    assert result.code == 2
    assert "add --preset vlm or --planner openai" in result.err


@pytest.mark.parametrize("preset", ["vlm-paper", "no-grid", "grid-2", "grid-4", "vlm-crop"])
def test_the_ablations_run(preset, cli, files):
    with serving(PAPER) as server:
        result = cli(*asking(files, server.url, preset=preset))
    model = DecisionModel.model_validate_json(result.out)
    grids = {"no-grid": 1, "grid-2": 2, "grid-4": 4}
    assert model.plan.grid == grids.get(preset, 3)
    assert model.plan.crop_xyxy is not None
    assert len(server.requests) >= 1


def test_no_vlm_takes_the_words_as_they_are(cli, files):
    color, depth, camera = files
    args = ["grasp", color, depth, "the red box", "--camera", camera, "--preset", "no-vlm", "--json"]
    result = cli(*args)
    model = DecisionModel.model_validate_json(result.out)
    assert (result.code, model.plan.target, model.plan.mark) == (0, "the red box", None)
    assert model.target is not None
    assert model.usage.requests == 0


def test_a_spent_budget_is_a_clear_outcome(cli, files):
    with serving(GOOD) as server:
        result = cli(*asking(files, server.url, "--set", "planner.budget_usd=0"))
    model = DecisionModel.model_validate_json(result.out)
    assert (result.code, model.status, server.requests) == (1, "no_target", [])
    assert "the budget of 0 USD allows no more requests" in model.plan.rationale


def test_no_key_is_one_clear_line(cli, files, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    color, depth, camera = files
    result = cli("grasp", color, depth, "the red box", "--camera", camera, "--preset", "vlm")
    assert result.code == 2
    assert "OPENAI_API_KEY is not set" in result.err
    assert len(result.err.splitlines()) == 1
