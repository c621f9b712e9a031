from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.benchmark import fake_source, small_plan

from thinkgrasp.benchmark.records import read_records
from thinkgrasp.benchmark.runner import run_benchmark

LAYOUT = "give me the pear\n0\nassets/simplified_objects/015.urdf 0.5 0.0 0.1 0 0 0\n"
SMALL = ("--suite", "clutter", "--tasks", "clutter-09-pear", "--runs", "1", "--size", "224x224")


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    folder = tmp_path / "finished"
    folder.mkdir()
    run_benchmark(small_plan(), folder, fake_source, lambda text: None)
    return folder


def test_a_benchmark_runs_goes_on_and_runs_again(tmp_path, cli: Callable):
    first, second = tmp_path / "first", tmp_path / "second"
    result = cli("bench", "run", *SMALL, "--preset", "oracle", "--out", str(first))
    assert (result.code, "1/1 oracle clutter-09-pear seed 1000: goal_delivered" in result.err) == (0, True)
    assert "| oracle" in result.out
    for name in ("benchmark.json", "records.jsonl", "report.md", "report.html", "rows.tex"):
        assert (first / name).is_file()
    result = cli("bench", "run", "--out", str(first))
    assert (result.code, result.err) == (0, "")
    result = cli("bench", "run", "--again", str(first), "--out", str(second))
    assert result.code == 0
    result = cli("bench", "compare", str(first), str(second))
    assert result.code == 0
    assert "same results: all 1 episodes that both hold are identical step by step" in result.out
    plan = json.loads((second / "benchmark.json").read_bytes())
    assert plan["methods"] == json.loads((first / "benchmark.json").read_bytes())["methods"]
    assert len(plan["sessions"]) == 1
    assert len(read_records(second).scenes) == 1


def test_layouts_named_from_another_folder_are_the_same_benchmark(tmp_path, cli: Callable, monkeypatch):
    monkeypatch.setattr("thinkgrasp.benchmark.runner.local_workers", lambda n: fake_source)
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "case00-pear.txt").write_text(LAYOUT)
    command = ("bench", "run", "--suite", "paper-clutter", "--runs", "2", "--out", str(tmp_path / "out"), "--cases")
    monkeypatch.chdir(tmp_path)
    assert "2/2 offline case00-pear" in cli(*command, "cases").err
    monkeypatch.chdir(tmp_path / "cases")
    result = cli(*command, ".")
    assert (result.code, result.err) == (0, "")


def test_a_report_is_written_anew(finished, cli: Callable):
    result = cli("bench", "report", str(finished), "--reference", "oracle")
    assert result.code == 0
    assert "| oracle" in result.out
    assert (finished / "report.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "--out", "OUT"), "holds no benchmark yet: add --suite"),
        (("run", "--out", "OUT", "--preset", "offline"), "holds no benchmark yet: add --suite"),
        (("run", "--suite", "cluter", "--out", "OUT"), "no suite 'cluter'"),
        (("run", "--suite", "clutter", "--preset", "ofline", "--out", "OUT"), "did you mean 'offline'"),
        (("run", "--suite", "clutter", "--tasks", "pear", "--out", "OUT"), "has no task 'pear'"),
        (("run", "--suite", "clutter", "--workers", "0", "--out", "OUT"), "--workers and --runs must be at least 1"),
        (("run", "--suite", "clutter", "--runs", "0", "--out", "OUT"), "--workers and --runs must be at least 1"),
        (("run", "--suite", "clutter", "--first-seed", "-1", "--out", "OUT"), "--first-seed must not be negative"),
        (("run", "--suite", "clutter", "--ray", "auto", "--workers", "2", "--out", "OUT"), "leave out --workers"),
        (("run", "--suite", "clutter", "--size", "big", "--out", "OUT"), "WIDTHxHEIGHT"),
        (("run", "--suite", "clutter", "--camera", "kinect", "--out", "OUT"), "kinect"),
        (("run", "--suite", "paper-clutter", "--out", "OUT"), "add --cases DIR"),
        (("run", "--suite", "paper-clutter", "--cases", "OUT", "--out", "OUT"), "holds no layouts"),
        (("run", "--suite", "clutter", "--again", "DONE", "--out", "OUT"), "leave out --suite and --preset"),
        (("run", "--again", "OUT", "--out", "OUT"), "give the folder of a benchmark"),
        (("run", "--again", "DONE", "--out", "DONE"), "--again and --out are one folder"),
        (
            ("run", "--suite", "heavy", "--out", "DONE"),
            "the folder holds a benchmark with suite clutter-v1, asked for is heavy-v1",
        ),
        (("run", "--suite", "clutter"), "--out"),
        (("report",), "needs the folder of a benchmark"),
        (("report", "OUT"), "give the folder of a benchmark"),
        (("report", "DONE", "--reference", "magic"), "no results of method 'magic'"),
        (("compare", "DONE", "OUT"), "give the folder of a benchmark"),
        (("compare", "DONE"), "B"),
        (("dance",), "dance"),
    ],
)
def test_bad_input_is_one_line(tmp_path, finished, cli: Callable, arguments, message):
    folders = {"OUT": str(tmp_path / "out"), "DONE": str(finished)}
    result = cli("bench", *(folders.get(a, a) for a in arguments))
    assert result.code == 2
    assert message in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert result.out == ""
