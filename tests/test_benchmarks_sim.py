"""The benchmarks of the closed loop run on the smallest that they can measure, and what they conclude is right."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

ROOT = Path(__file__).resolve().parents[1]
YCB = ROOT.parent / "shared" / "objects_ycb"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch):
    """Import a benchmark by name, as its siblings and the processes it starts do."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    return importlib.import_module


def test_a_torn_line_is_cut_off_and_the_file_goes_on(bench, tmp_path: Path) -> None:
    trials, kind = bench("trials"), tuple[str, int]
    path = tmp_path / "trials.jsonl"
    log = trials.TrialLog(path, kind)
    log.add(("pear", 0))
    log.add(("pear", 1))
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    again = trials.TrialLog(path, kind)
    assert again.records == [("pear", 0)]
    again.add(("pear", 1))
    assert path.read_bytes() == whole


def test_grasping_prints_a_row_per_object(bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench("grasping").main(per_object=1, objects=("pear", "mug"), workers=1)
    out = capsys.readouterr().out
    assert "target 93 %" in out
    for name in ("| pear | fruit |", "| mug | drinkware |"):
        assert name in out


def test_an_episode_is_asked_for_by_the_name_of_an_own_object(bench) -> None:
    if not YCB.is_dir():
        pytest.skip(f"{YCB} is not there")
    own = bench("own_objects")
    record = own.ask_for(own.Settings(YCB, "offline", (224, 224)), ("banana", 0))
    assert (record.task, record.end) == ("banana", "goal_delivered")
    report = own.report([record, replace(record, seed=1, success=False, end="step_limit", steps=15)]).splitlines()
    assert report[2].startswith("| banana | 1/2 = 50.0 %")
    assert report[3].endswith("| goal_delivered 1, step_limit 1 |")


def test_the_parts_of_an_attempt_add_up_to_it(bench) -> None:
    attempts = bench("attempts")
    (timed,) = attempts.measure(attempts.Settings(attempts=1, objects=12))
    assert sum(timed.parts.values()) == pytest.approx(timed.seconds)
    assert all(seconds >= 0 for seconds in timed.parts.values())
    assert timed.parts["physics"] > 0
    assert timed.parts["rendering"] > 0
    text = attempts.report([timed], 12)
    assert "| motion planning |" in text
    assert "target at most 1.5 s" in text


def test_times_of_nested_calls_count_once(bench) -> None:
    attempts = bench("attempts")

    class Both:
        def outer(self) -> int:
            return self.inner() + 1

        def inner(self) -> int:
            return 1

    watch = attempts.Stopwatch()
    with watch.watching({"outer": (Both, ("outer",)), "inner": (Both, ("inner",))}):
        assert Both().outer() == 2
    assert set(watch.seconds) == {"outer"}


def test_generators_are_compared_scene_by_scene_and_not_run_twice(
    bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    generators = bench("generators")
    out = tmp_path / "generators.jsonl"

    def run() -> str:
        generators.main(tmp_path / "none.pth", suite="single", methods=("antipodal",), scenes=1, workers=1, out=out)
        return capsys.readouterr().out

    first = run()
    assert "| antipodal | 1/1 = 100.0 %" in first
    monkeypatch.setattr(generators, "run_all", lambda work, jobs, workers: iter([work(job) for job in jobs]))
    monkeypatch.setattr(generators, "run_job", None)
    assert run() == first


def test_the_comparison_of_generators_says_where_each_wins(bench) -> None:
    generators = bench("generators")

    def trial(scene: str, method: str, reason: str):
        return generators.Trial(
            generators.SCHEMA, "single", scene, 0, method, scene, "fruit", "compact", reason, "score 0.9",
            9, 4, 100.0, 50.0, 300.0, 2.0,
        )  # fmt: skip

    trials = [
        *(trial(scene, "antipodal", reason) for scene, reason in (("pear", "held"), ("plum", "slipped"))),
        *(trial(scene, "joint", reason) for scene, reason in (("pear", "held"), ("plum", "held"))),
    ]
    text = generators.report(trials)
    assert "| antipodal | 1/2 = 50.0 %" in text
    assert "| joint | 1 | 1 | 0 | 0 | 1.00 |" in text
    assert "| compact | 1/2 | 2/2 |" in text
    assert "- plum seed 0, plum: antipodal slipped (score 0.9), joint held" in text
    assert "pear seed" not in text
    assert len(generators.suite_scenes("single", None)) == 150
    assert len(generators.suite_scenes("clutter", None)) == 60
    assert len(set(generators.suite_scenes("clutter", 20))) == 20


def test_the_cost_of_vgn_is_measured_without_weights_too(bench, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")
    bench("vgn_cost").main(threads=1, repeats=1)
    text = capsys.readouterr().out
    for part in ("TSDF, 1 view of 320x240", "network, 3 cubes", "torch imported"):
        assert f"| {part} |" in text
