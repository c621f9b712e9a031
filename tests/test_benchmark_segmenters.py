"""The benchmark of the learned segmenters runs, on small networks."""

from __future__ import annotations

import pytest
from fakes.models import model
from test_benchmarks import load

pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")


@pytest.mark.parametrize(
    ("name", "kinds"),
    [("grounded_sam", ("grounding_dino", "sam")), ("grounded_sam2", ("grounding_dino", "sam2")), ("sam3", ("sam3",))],
)
def test_a_row_is_measured(monkeypatch, tmp_path, name, kinds):
    bench = load("segmenters", monkeypatch)
    for number, kind in enumerate(kinds):
        (tmp_path / str(number)).symlink_to(model(kind))
    row = bench.measure(name, tmp_path, (96, 64), 2, None, {"device": "cpu", "dtype": "float32"})
    assert row.parameters > 1000
    assert row.load_s > 0
    assert min(*row.first_s, *row.second_s) > 0
    assert row.peak_mib > 10
    assert {save.__name__ for save in bench.CONTENDERS[name].save} == {f"save_{kind}" for kind in kinds}
