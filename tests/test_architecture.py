"""Imports go one way: each part may use only the parts below it, and no stage another stage."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "thinkgrasp"

ORDER = [
    ["errors"],
    ["weights"],
    ["types"],
    ["geometry", "gripper", "outputs"],
    ["contacts", "fusion"],
    ["closure"],
    ["memory"],
    ["motion"],
    ["networks"],
    ["interfaces"],
    ["registry"],
    ["language"],
    ["perception", "planners", "segmenters", "generators", "checks"],
    ["selection"],
    ["pipeline"],
    ["loop", "config"],
    ["schema", "loop_stages"],
    ["episode"],
    ["sim"],
    ["lab"],
    ["cameras", "robots"],
    ["handeye"],
    ["viz"],
    ["recorder", "telling"],
    ["testbed"],
    ["environment", "demo", "benchmark", "run", "calibrate"],
    ["testing"],
    ["doctor", "server"],
    ["commands"],
    ["cli"],
]
"""Lowest first; parts on one line must not import one another."""

LEVEL = {part: level for level, parts in enumerate(ORDER) for part in parts}

EXCEPTIONS = {
    ("planners", "selection"): {"thinkgrasp.selection"},
    ("segmenters", "selection"): {"thinkgrasp.selection"},
    ("perception", "selection"): {"thinkgrasp.selection"},
}
"""Pure maths that has one home: the numbering of the grid's cells."""


def modules() -> dict[str, Path]:
    found = {}
    for path in SOURCE.rglob("*.py"):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        name = ".".join(("thinkgrasp", *(p for p in parts if p != "__init__")))
        found[name] = path
    return found


MODULES = modules()


def imported(name: str, path: Path) -> set[str]:
    """Modules of the package that a module imports, wherever in the file; type-checking imports count too."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                base = ".".join([*parents[: len(parents) - node.level + 1], *filter(None, [base])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                found.add(full if full in MODULES else base)
    return {m for m in found if m == "thinkgrasp" or m.startswith("thinkgrasp.")}


IMPORTS = {name: imported(name, path) for name, path in MODULES.items()}


def part(module: str) -> str | None:
    """The part a module belongs to; None for the package itself, which holds the version."""
    return module.split(".")[1] if "." in module else None


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_go_one_way(module):
    own = part(module)
    if own is None:
        return  # the package's own __init__ names everything, lazily
    assert own in LEVEL, f"{own} has no place in the order of imports; add it to ORDER"
    for other in sorted(IMPORTS[module]):
        theirs = part(other)
        if theirs is None or theirs == own or other in EXCEPTIONS.get((own, theirs), set()):
            continue
        assert theirs in LEVEL, f"{module} imports {other}, which has no place in the order"
        assert LEVEL[theirs] < LEVEL[own], f"{module} must not import {other}: {theirs} is not below {own}"


def test_no_cycles():
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path[path.index(module) :], module))
        if module in done:
            return
        for other in sorted(IMPORTS.get(module, set())):
            # A module's own package is not a cycle: __init__ re-exports what it holds.
            if other != "thinkgrasp" and other != module and not module.startswith(f"{other}."):
                visit(other, (*path, module))
        done.add(module)

    for module in sorted(MODULES):
        if module != "thinkgrasp":
            visit(module, ())


def test_the_pipeline_names_no_plugin():
    stages = {"perception", "planners", "segmenters", "generators", "checks", "cameras"}
    for module in ("thinkgrasp.pipeline", "thinkgrasp.config", "thinkgrasp.registry", "thinkgrasp.interfaces"):
        assert not {part(m) for m in IMPORTS[module]} & stages


def test_source_never_imports_tests():
    for path in MODULES.values():
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.split(".")[0] in ("tests", "fakes", "conftest", "pytest", "hypothesis") for n in names)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_house_rules(module):
    path = MODULES[module]
    assert path.stem not in ("utils", "helpers", "common", "misc"), "name a file by its concept"
    assert len(path.read_text().splitlines()) <= 480, "about 400 lines at most: split by concept"
    text = path.read_text()
    assert not text.strip() or ast.get_docstring(ast.parse(text)), "each module says what it holds"
