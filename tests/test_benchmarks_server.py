"""The server's benchmarks run, and notice what they are there to notice."""

from __future__ import annotations

from pathlib import Path

import pytest
from fakes.grasp_server import parts_of, running, told_recipe
from fakes.stages import table_frame
from test_benchmarks import load

from thinkgrasp.server.app import ServerOptions


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch):
    return load("server_load", monkeypatch)


def test_load_prints_answers_latency_and_memory(bench, monkeypatch, capsys, tmp_path: Path):
    monkeypatch.setattr(bench, "requests", lambda: [parts_of(table_frame(), "red")])
    monkeypatch.setattr(bench, "GROWTH_LIMIT", 9.0)
    with running(told_recipe(), ServerOptions(workers=0)) as server:
        bench.main(clients=2, minutes=0.03, url=server.url, out=tmp_path / "samples.json")
    out = capsys.readouterr().out
    assert "| answers | 200 | 429 | other | per second | p50 | p95 | p99 |" in out
    assert "growth after settling" in out
    assert (tmp_path / "samples.json").stat().st_size > 100


def test_load_fails_where_an_answer_is_neither_200_nor_429(bench, monkeypatch, capsys):
    monkeypatch.setattr(bench, "requests", lambda: [parts_of(table_frame(), "red bug")])
    with (
        running(told_recipe(), ServerOptions(workers=0)) as server,
        pytest.raises(SystemExit) as stopped,
    ):
        bench.main(clients=1, minutes=0.02, url=server.url)
    assert stopped.value.code == 1


def test_growth_is_seen(bench):
    level = [(float(t), 50.0, 100.0) for t in range(50)]
    rising = [(float(t), 50.0, 100.0 + t) for t in range(50)]
    filling = [(float(t), 50.0, min(100.0, 50.0 + 10 * t)) for t in range(50)]
    assert bench.growth(level) == 0
    assert bench.growth(filling) == 0
    assert bench.growth(rising) > 0.1
    assert bench.growth([]) > 0.1, "memory that was not seen"
    assert bench.growth([(0.0, 0.0, 0.0)]) > 0.1, "nor read"
