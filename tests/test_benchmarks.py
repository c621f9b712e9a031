"""The benchmarks run: one rendered scene of each kind, from the file that the docs name."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import a benchmark by its path."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_perception_benchmark_prints_a_line_per_kind_and_draws(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    bench = load("perception", monkeypatch)
    kinds = {name: bench.KINDS[name] for name in ("apart", "small-table")}
    monkeypatch.setattr(bench, "KINDS", kinds)
    monkeypatch.setattr(bench, "SMEARED", {})
    bench.main(scenes=1, show=tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(kinds)
    for name, line in zip(kinds, lines[1:], strict=True):
        row = re.fullmatch(r"(\S+) +(\d+) +([\d.]+) +([\d.]+) +([\d.]+) +(\d)/1", line)
        assert row is not None, line
        assert row[1] == name
        assert int(row[2]) > 0
        assert 0.5 <= float(row[3]) <= 1
        assert 0.5 <= float(row[4]) <= 1
        assert (tmp_path / f"{name}-0.png").is_file()


def test_random_scenes_depend_on_the_seed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = load("perception", monkeypatch)
    for kind in bench.KINDS.values():
        first, second = (bench.random_scene(kind, np.random.default_rng(5)) for _ in range(2))
        assert [o.name for o in first.objects] == [o.name for o in second.objects]
        assert 1 <= len(first.objects) <= kind.objects[1]
        for a, b in zip(first.objects, second.objects, strict=True):
            np.testing.assert_array_equal(a.T_world_object, b.T_world_object)
