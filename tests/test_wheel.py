"""The built wheel holds everything that a user needs: it is installed into an empty folder and decides."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.testing import sample_frame

ROOT = Path(__file__).resolve().parents[1]
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]
DATA = (
    *("py.typed", "language/knowledge.toml", "language/vocabulary.toml", "sim/paper_objects.toml"),
    *("viz/report.css", "viz/report.html", "viz/report.js", "viz/view.html", "viz/view.js"),
)
ABSENT = "raise ModuleNotFoundError('No module named {0}', name='{0}')"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [*PIP, "wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory) -> Path:
    """The wheel installed into a folder of its own."""
    folder = tmp_path_factory.mktemp("site")
    command = [*PIP, "install", "--no-index", "--no-deps", "--target", str(folder), str(wheel)]
    subprocess.run(command, capture_output=True, timeout=180, check=True)
    return folder


def run(site: Path, cwd: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """Run the installed command where the packages of the `sim` extra are missing."""
    without = cwd / "without"
    without.mkdir()
    for name in ("mujoco", "trimesh", "gymnasium"):
        (without / f"{name}.py").write_text(ABSENT.format(name))
    code = f"import sys, thinkgrasp; assert thinkgrasp.__file__.startswith({str(site)!r}), thinkgrasp.__file__; "
    code += f"from thinkgrasp.cli import main; sys.exit(main({list(args)!r}))"
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (site, without)))},
        cwd=cwd,
    )


def test_it_holds_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {n.split("/")[0] for n in names if ".dist-info/" not in n} == {"thinkgrasp"}
    source = ROOT / "src"
    for path in source.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc":
            assert path.relative_to(source).as_posix() in names
    assert {f"thinkgrasp/{name}" for name in DATA} <= names
    assert any(n.endswith("licenses/LICENSE") for n in names)


def test_it_decides(site, tmp_path):
    color, depth, camera = map(str, save_frame(sample_frame(), tmp_path))
    view = tmp_path / "view.html"
    done = run(site, tmp_path, "grasp", color, depth, "the red box", "--camera", camera, "--json", "--view", str(view))
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["status"] == "grasp"
    assert view.stat().st_size > 10_000


def test_the_demo_says_what_to_install(site, tmp_path):
    done = run(site, tmp_path, "demo", "--out", str(tmp_path / "out"))
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert done.stderr == (
        "error: the simulated episode needs the package 'mujoco-core', which is not installed; "
        "install it with: pip install 'thinkgrasp[sim]'\n"
    )
