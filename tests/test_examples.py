"""Each example runs as its docstring says, and does what it says."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("[0-9]*.py"))
SAYS = {
    "01_grasp_from_files.py": "'the red box': grasp",
    "02_why_this_grasp.py": "times [ms]:",
    "03_your_own_planner.py": "the planner keeps its contract",
    "05_gymnasium.py": "reward 1.0",
    "04_decision_as_json.py": "schema thinkgrasp/decision-1, status grasp",
}


def test_all_are_here():
    assert [p.name for p in EXAMPLES] == sorted(SAYS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path, tmp_path):
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    assert docstring
    assert f"python examples/{path.name}" in docstring
    done = subprocess.run(
        [sys.executable, "-W", "error", str(path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert SAYS[path.name] in done.stdout
