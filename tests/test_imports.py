"""Importing is cheap, and the public names are exactly those that are promised."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

import thinkgrasp
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.testing import sample_frame

HEAVY = (
    *("torch", "mujoco", "trimesh", "gymnasium", "coacd", "ruckig", "ompl", "viser", "openai", "transformers"),
    *("ray", "fastapi", "matplotlib", "cv2", "open3d"),
)


def modules_after(code: str) -> set[str]:
    script = f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.parametrize("code", ["import thinkgrasp", "import thinkgrasp.cli", "import thinkgrasp.config"])
def test_no_optional_package_is_loaded(code):
    assert not modules_after(code) & set(HEAVY)


def test_import_loads_no_stage_and_no_array_library():
    loaded = modules_after("import thinkgrasp")
    assert not loaded & {"numpy", "scipy", "PIL", "pydantic", "tyro", "rich"}
    assert {m for m in loaded if m.startswith("thinkgrasp")} == {"thinkgrasp"}


def test_the_command_starts_without_arrays():
    assert not modules_after("import thinkgrasp.cli") & {"numpy", "scipy", "PIL", "pydantic"}


def test_making_the_pipeline_loads_no_optional_package():
    assert not modules_after("import thinkgrasp; thinkgrasp.make_pipeline('offline')") & set(HEAVY)


def test_a_grasp_on_files_works_without_the_simulator(tmp_path):
    """Every package of the simulator raises when it is imported."""
    for name in ("mujoco", "trimesh", "gymnasium", "coacd", "ruckig", "ompl"):
        (tmp_path / f"{name}.py").write_text(f"raise AssertionError('{name} is imported')")
    color, depth, camera = save_frame(sample_frame(), tmp_path)
    args = ["grasp", str(color), str(depth), "the red box", "--camera", str(camera), "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "thinkgrasp.cli", *args],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["status"] == "grasp"


def test_all_names_exist_and_no_others_are_public():
    assert len(set(thinkgrasp.__all__)) == len(thinkgrasp.__all__)
    assert dir(thinkgrasp) == sorted(thinkgrasp.__all__)
    for name in thinkgrasp.__all__:
        assert getattr(thinkgrasp, name) is not None
    assert set(thinkgrasp._HOME) | {"__version__"} == set(thinkgrasp.__all__)


def test_names_come_from_where_they_are_defined():
    for name, home in thinkgrasp._HOME.items():
        assert getattr(thinkgrasp, name).__module__ == f"thinkgrasp.{home}"


def test_unknown_name():
    with pytest.raises(AttributeError, match="has no attribute 'grasp_it'"):
        _ = thinkgrasp.grasp_it


def test_typed():
    from importlib.resources import files

    assert files("thinkgrasp").joinpath("py.typed").is_file()


def test_import_loads_little_of_python_itself():
    assert len(modules_after("import thinkgrasp") - modules_after("")) <= 20
