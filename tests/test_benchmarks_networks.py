"""The benchmarks of networks run, here on small ones."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import TINY  # noqa: E402

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.parametrize("text", ["table", "tower"])
def test_vlpart_cost_measures_each_column(tmp_path, monkeypatch, text):
    spec = importlib.util.spec_from_file_location("benchmark_vlpart_cost", BENCHMARKS / "vlpart_cost.py")
    assert spec is not None
    assert spec.loader is not None
    bench = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, bench)
    spec.loader.exec_module(bench)
    small = {"width": 64, "layers": 1, "vocabulary": 400, "out": TINY.text_width}
    monkeypatch.setattr(bench, "TOWER", small)
    bench.write_files(tmp_path, TINY)
    setting = bench.Setting(threads=torch.get_num_threads(), width=64, height=48, images=1)
    row = bench.measure(tmp_path, text, setting, TINY)
    assert len(row) == len(bench.COLUMNS)
    assert all(value > 0 for value in row[:-1])
    assert row[4] < row[1]
