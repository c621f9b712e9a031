"""The benchmark of success over model quality: its jobs, its report, its plot, and going on after an interruption."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch):
    """Import a benchmark by name, as its siblings do."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module


@pytest.fixture
def quality(bench):
    return bench("vlm_quality")


def records(quality, n: int = 4):
    jobs = [quality.Job(preset, p, i) for preset in ("vlm", "vlm-paper") for p in (1.0, 0.0) for i in range(n)]
    return [
        quality.QualityRecord(job, "goal_delivered" if job.accuracy or job.episode == 0 else "step_limit", 5, 4, 2, 7,
                              700, 70, 1, 3.5)
        for job in jobs
    ]  # fmt: skip


def test_episodes_go_through_the_tasks_and_then_the_seeds(quality):
    jobs = [quality.Job("vlm", 1.0, n) for n in (0, 9, 10, 29)]
    assert [(job.task.split("-")[1], job.seed) for job in jobs] == [("00", 0), ("09", 0), ("00", 1), ("09", 2)]


def test_a_row_per_preset_and_accuracy(quality):
    lines = quality.report(records(quality)).splitlines()
    assert len(lines) == 2 + 4
    assert lines[2].startswith("| vlm | 1 | 4/4 = 100.0 %")
    assert lines[3].startswith("| vlm | 0 | 1/4 = 25.0 %")
    assert "| 5.0 | 7.0 | 700 + 70 | 16/24 | 4 | goal_delivered 1, step_limit 3 |" in lines[3]


def test_the_plot_is_svg_with_a_spot_and_an_interval_per_point(quality, bench):
    found = quality.curves(records(quality))
    assert [curve.name for curve in found] == ["vlm", "vlm-paper"]
    assert [point[:2] for point in found[0].points] == [(0.0, 0.25), (1.0, 1.0)]
    assert all(low <= y <= high for curve in found for _, y, low, high in curve.points)
    svg = ElementTree.fromstring(bench("quality_plot").plot(found, "a < b", "x"))
    tag = "{http://www.w3.org/2000/svg}"
    assert len(svg.findall(f"{tag}circle")) == 4
    assert len(svg.findall(f"{tag}polyline")) == 2
    assert "a < b" in [text.text for text in svg.iter(f"{tag}text")]


def test_an_interrupted_run_goes_on(quality, tmp_path, monkeypatch):
    done = records(quality)
    out = tmp_path / "out.jsonl"
    monkeypatch.setattr(quality, "run_all", lambda work, jobs, workers: (r for r in done if r.job in jobs))
    quality.run_jobs([r.job for r in done[:3]], 1, out)
    with out.open("ab") as file:
        file.write(b'{"job": {"preset": "vl')
    seen = []
    monkeypatch.setattr(
        quality, "run_all", lambda work, jobs, workers: (seen.append(r) or r for r in done if r.job in jobs)
    )
    assert quality.run_jobs([r.job for r in done], 1, out) == done
    assert seen == done[3:]
    assert quality.run_jobs([r.job for r in done], 1, out) == done
    assert len(out.read_bytes().splitlines()) == len(done)


def test_a_crash_is_a_record(quality, monkeypatch, capsys):
    def broken(*_):
        raise ValueError("no such planner")

    monkeypatch.setattr(quality, "config", broken)
    record = quality.run_job(replace(records(quality)[0].job, episode=9))
    assert (record.end, record.error, record.success) == ("crashed", "ValueError: no such planner", False)
    assert "no such planner" in capsys.readouterr().err
