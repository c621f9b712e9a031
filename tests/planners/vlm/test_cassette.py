"""Questions and replies on the disk, and a planner that is answered from there."""

from __future__ import annotations

import io
import json
from base64 import b64decode

import pytest
from fakes.chat_server import dead_url, error, good, serving
from fakes.openai_planner import ASK, GOOD, GREEN, REPLY, SCENE, WRONG_MARK, planner, reasons, recorded
from PIL import Image

from thinkgrasp.errors import ConfigError
from thinkgrasp.memory import Memory

pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")


def test_a_recorded_episode_is_replayed_without_network_or_key(tmp_path, monkeypatch):
    path = tmp_path / "cassette.jsonl"
    asks = (ASK, ASK, "the blue thing", "the red thing")
    with serving(error(500), GOOD, WRONG_MARK, GOOD, error(401), good(REPLY | {"cell": 1})) as server:
        asked = planner(server, record=path)
        recorded = [asked.plan(SCENE, ask, Memory()) for ask in asks]
        asked.close()
    monkeypatch.delenv("TEST_KEY")
    again = planner(dead_url(), replay=path)
    replayed = [again.plan(SCENE, ask, Memory()) for ask in asks]
    assert replayed == recorded
    assert again.spent.usd == asked.spent.usd
    assert again.spent.latency_s == pytest.approx(asked.spent.latency_s, abs=0.01)
    assert "HTTP 401" in reasons(recorded[2])
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0] == {"schema": "thinkgrasp/cassette-1"}
    assert sum("image" in line for line in lines) == 1
    assert sum("question" in line for line in lines) == 5
    with Image.open(io.BytesIO(b64decode(next(line["jpeg"] for line in lines if "jpeg" in line)))) as image:
        assert image.size == (640, 480)


def test_a_cassette_grows_and_keeps_each_image_once(tmp_path):
    path = tmp_path / "cassette.jsonl"
    before = recorded(path).read_text()
    after = recorded(path).read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == len(before.splitlines()) + 1


def test_an_unknown_request_fails_clearly(tmp_path):
    path = recorded(tmp_path / "cassette.jsonl")
    asked = planner(dead_url(), replay=path)
    with pytest.raises(ConfigError, match=r"cassette\.jsonl' does not hold the request [0-9a-f]{64}"):
        asked.plan(SCENE, "something else", Memory())


def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    path = recorded(tmp_path / "cassette.jsonl")
    path.write_text(path.read_text() + '{"question": "ab')
    assert planner(dead_url(), replay=path).plan(SCENE, ASK, Memory()).mark == GREEN


@pytest.mark.parametrize(
    "text", ["", "{}\n", "hello\n", "[]\n", '{"schema": "thinkgrasp/cassette-1"}\n{"question": "a"}\n']
)
def test_what_is_no_cassette_is_refused(tmp_path, text):
    path = tmp_path / "cassette.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigError, match="cassette"):
        planner(dead_url(), replay=path)
