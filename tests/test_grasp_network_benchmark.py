"""The benchmark of the grasp networks: both implementations agree, and the plot is a picture."""

from __future__ import annotations

import importlib
from pathlib import Path
from xml.etree import ElementTree

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("grasp_networks")


@pytest.mark.parametrize("name", ["graspnet", "fgc"])
def test_both_implementations_agree(bench, name, tmp_path):
    words = bench.same(bench.load(name, tmp_path), bench.table_cloud(2500))
    assert words.endswith("other views 0 of 1024")
    assert float(words.split()[5].rstrip(",")) < 1e-3


def test_the_plot_is_a_picture(bench):
    svg = bench.cost_plot.plot({"a < b": [(5000, 130.0), (40_000, 1100.0)]}, "cost", "points")
    root = ElementTree.fromstring(svg)
    texts = [t.text for t in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"a < b", "cost", "points", "5,000", "40,000", "0 ms"} <= set(texts)
    ys = [float(c.get("cy")) for c in root.iter("{http://www.w3.org/2000/svg}circle")]
    assert 0 < ys[1] < ys[0] < bench.cost_plot.HEIGHT
