"""A torchvision that does not fit beside torch is named, with the cure: by the doctor and where models are loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

BROKEN = "raise RuntimeError('operator torchvision::nms does not exist')"
TORCH = torch.__version__.partition("+")[0]
CURE = "pip uninstall -y torchvision"


def put_torchvision(folder: Path, code: str, version: str = "0.20.1", needs: str = f"torch=={TORCH}") -> None:
    """Make a package of that name, as pip would leave it."""
    (folder / "torchvision").mkdir()
    (folder / "torchvision" / "__init__.py").write_text(code)
    info = folder / f"torchvision-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: torchvision\nVersion: {version}\nRequires-Dist: {needs}\n"
    )


def run(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, *args], capture_output=True, text=True, env=environment, check=False, timeout=180
    )


@pytest.mark.parametrize(
    ("code", "version", "needs", "problem"),
    [
        (BROKEN, "0.20.1", f"torch=={TORCH}", "RuntimeError: operator torchvision::nms does not exist"),
        ("import no_such_library", "0.20.1", f"torch=={TORCH}", "No module named 'no_such_library'"),
        ("", "0.20.1", "torch==2.5.1", "torchvision 0.20.1 beside torch"),
        ("", "0.20.1+cu124", f"torch (=={TORCH})", "one is a build for cu124, the other for cpu"),
    ],
)
def test_what_is_wrong_with_torchvision(tmp_path, code, version, needs, problem):
    put_torchvision(tmp_path, code, version, needs)
    if "cu124" in version and "+" not in torch.__version__:
        pytest.skip("this torch does not say what it was built for")
    done = run(tmp_path, "-c", "from thinkgrasp.networks.torch_install import torchvision_problem as t; print(t())")
    assert done.stderr == ""
    assert problem in done.stdout


def test_one_that_fits_and_none_at_all_are_no_problem(tmp_path):
    check = "from thinkgrasp.networks.torch_install import torchvision_problem as t; print(t())"
    assert run(tmp_path, "-c", check).stdout == "None\n"
    put_torchvision(tmp_path, "")
    assert run(tmp_path, "-c", check).stdout == "None\n"


def test_the_doctor_names_the_problem_and_the_cure(tmp_path):
    put_torchvision(tmp_path, BROKEN)
    done = run(tmp_path, "-m", "thinkgrasp.cli", "doctor")
    assert "PROBLEM: torchvision 0.20.1 beside torch" in done.stdout
    assert "cannot be imported, which breaks transformers' models" in done.stdout
    assert CURE in done.stdout


def test_loading_a_model_names_the_problem_and_the_cure(tmp_path):
    put_torchvision(tmp_path, BROKEN)
    code = """
from thinkgrasp import registry
from thinkgrasp.errors import ConfigError
try:
    registry.load("segmenter", "grounded_sam")
except ConfigError as error:
    print(error)
"""
    done = run(tmp_path, "-c", code)
    assert "torchvision 0.20.1 beside torch" in done.stdout, done.stderr
    assert CURE in done.stdout
