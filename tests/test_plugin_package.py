"""A third-party package is installed beside thinkgrasp, found by entry point, configured and used for every stage."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fakes.stages import table_frame

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.registry import KINDS

PACKAGE = Path(__file__).parent / "plugin_package"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder into which the package was built and installed as a user would, without network."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "package"
    import shutil

    shutil.copytree(PACKAGE, source)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"]
    done = subprocess.run(
        [*pip, "--no-deps", "--no-build-isolation", "--target", str(folder), str(source)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PIP_ROOT_USER_ACTION": "ignore"},
    )
    assert done.returncode == 0, done.stderr
    return folder


def run(site: Path, *command: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=120, check=False, env=env)


def test_it_is_not_there_before(pytestconfig):
    done = subprocess.run(
        [sys.executable, "-m", "thinkgrasp.cli", "plugins"], capture_output=True, text=True, timeout=60, check=True
    )
    assert "acme" not in done.stdout


def test_it_is_listed_for_every_kind(site):
    done = run(site, "-m", "thinkgrasp.cli", "plugins")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("[acme-grasping]") == len(KINDS)


def test_every_stage_is_replaced_and_configured_from_the_command_line(site, tmp_path):
    paths = [str(p) for p in save_frame(table_frame(), tmp_path)]
    stages = [f for kind in ("scene", "planner", "segmenter", "generator") for f in (f"--{kind}", "acme")]
    settings = ["scene.margin_m=0.05", "planner.grid=5", "generator.count=7", 'checks=["acme"]', "checks.acme.most_m=3"]
    sets = [f for s in settings for f in ("--set", s)]
    done = run(
        site, "-m", "thinkgrasp.cli", "grasp", *paths[:2], "anything", "--camera", paths[2], *stages, *sets, "--json"
    )
    assert done.returncode == 0, done.stderr
    data = json.loads(done.stdout)
    assert data["plan"]["rationale"] == "it is nearest to the camera"
    assert data["plan"]["grid"] == 5
    assert data["plan"]["cell"] == 13
    assert data["funnel"][-1] == {"check": "acme", "in": 7, "out": 7}
    assert data["grasp"]["score"] == 1.0


def test_its_settings_are_checked_by_itself(site, tmp_path):
    paths = [str(p) for p in save_frame(table_frame(), tmp_path)]
    args = ["-m", "thinkgrasp.cli", "grasp", *paths[:2], "anything", "--camera", paths[2], "--scene", "acme"]
    done = run(site, *args, "--set", "scene.margin_m=-1")
    assert done.returncode == 2
    assert done.stderr.startswith("error: scene 'acme' refuses its settings")
    assert "margin_m must be positive, got -1" in done.stderr


def test_it_passes_the_contract_checks(site, tmp_path):
    script = f"""
from thinkgrasp import registry, testing
for kind in ("scene", "planner", "segmenter", "generator", "check", "camera", "robot"):
    getattr(testing, f"check_{{kind}}")(registry.load(kind, "acme"))
testing.check_recorder(registry.load("recorder", "acme", path={str(tmp_path / "log.txt")!r}))
print("kept", "torch" in __import__("sys").modules)
"""
    done = run(site, "-c", script)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "kept False\n"
    assert len((tmp_path / "log.txt").read_text().splitlines()) == 3


def test_it_works_from_python(site):
    script = """
from thinkgrasp import make_pipeline, registry
frame = registry.load("camera", "acme", height_m=0.9).read()
pipeline = make_pipeline(scene="acme", planner="acme", segmenter="acme", generator="acme", checks=["acme"])
decision = pipeline.decide(frame, "anything")
print(decision.status, registry.load("robot", "acme").execute(decision.grasp, frame).reason)
"""
    done = run(site, "-c", script)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "grasp held\n"
