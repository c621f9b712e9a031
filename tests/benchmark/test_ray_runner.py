from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("ray", reason="needs thinkgrasp[ray]: make test-ray")

from fakes.benchmark import small_plan

from thinkgrasp.benchmark.ray_runner import ray_workers
from thinkgrasp.benchmark.results import same_results
from thinkgrasp.benchmark.runner import local_workers, run_benchmark
from thinkgrasp.errors import ConfigError
from thinkgrasp.sim.options import CameraOptions


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_gives_the_numbers_of_local_processes(tmp_path):
    plan = replace(small_plan(("oracle", "vlm@0.5"), runs=1), camera=CameraOptions(size_wh=(224, 224)))
    found = []
    for name, source in (("ray", ray_workers("local")), ("local", local_workers(2))):
        (tmp_path / name).mkdir()
        found.append(run_benchmark(plan, tmp_path / name, source, lambda text: None))
    assert len(found[0].episodes) == 4
    assert same_results(*found) == ()


@pytest.mark.filterwarnings("ignore")
def test_a_method_that_cannot_run_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"^method 'planner=mine' cannot run here: no planner named 'mine'"):
        run_benchmark(small_plan(("planner=mine",)), tmp_path, ray_workers("local"), lambda text: None)
    assert not (tmp_path / "benchmark.json").exists()


def test_no_cluster_is_named():
    with pytest.raises(ConfigError, match=r"the Ray cluster '127.0.0.1:1' cannot be reached"):
        ray_workers("127.0.0.1:1")
