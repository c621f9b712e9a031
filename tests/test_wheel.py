"""The built wheel holds everything that a user needs: it is installed into an empty folder and decides."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [*PIP, "wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


def test_it_holds_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {n.split("/")[0] for n in names if ".dist-info/" not in n} == {"thinkgrasp"}
    source = ROOT / "src"
    for path in source.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc":
            assert path.relative_to(source).as_posix() in names
    assert any(n.endswith("licenses/LICENSE") for n in names)


def test_it_decides(wheel, tmp_path):
    site = tmp_path / "site"
    command = [*PIP, "install", "--no-index", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(command, capture_output=True, timeout=180, check=True)
    env = {**os.environ, "PYTHONPATH": str(site)}
    code = "import thinkgrasp, sys; from thinkgrasp.cli import main; print(thinkgrasp.__file__, file=sys.stderr); "
    code += "sys.exit(main(['demo', 'the red box', '--out', 'out', '--json']))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False, env=env, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith(str(site)), "the installed wheel was used, not the source"
    assert json.loads(done.stdout)["status"] == "grasp"
    assert (tmp_path / "out" / "view.html").stat().st_size > 10_000
