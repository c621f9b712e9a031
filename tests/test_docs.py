"""What the pages say is true: links lead somewhere, code runs, names and commands exist."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

from thinkgrasp import cli, registry, testing
from thinkgrasp.errors import ContractError

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_named_modules_and_tests_exist(page):
    text = page.read_text()
    for path in re.findall(r"`((?:tests|examples|docs)/[\w./]+)`", text):
        assert (ROOT / path).exists(), path
    for name in re.findall(r"`(thinkgrasp(?:\.\w+)+)`", text):
        if name.removeprefix("thinkgrasp.") in registry.KINDS:
            continue
        module, _, attribute = name.rpartition(".")
        try:
            import_module(name)
        except ImportError:
            assert hasattr(import_module(module), attribute), name


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_and_flags_exist(page, capsys):
    for command, rest in re.findall(r"\$ thinkgrasp ((?:bench )?\w+)((?:[^\n`]|\\\n)*)", page.read_text()):
        assert cli.main([*command.split(), "--help"]) == 0
        usage = capsys.readouterr().out
        for flag in re.findall(r" (--[a-z-]+)", rest):
            assert flag in usage, f"{command} {flag}"


def test_the_plugin_page_example_keeps_its_contract():
    written, check, used = blocks(ROOT / "docs" / "plugins.md", "python")
    names: dict[str, object] = {}
    exec(compile(written, "plugins.md", "exec"), names)
    make = names["Reach"]
    testing.check_check(make())  # type: ignore[operator]
    with pytest.raises(ValueError, match="most_m must be positive"):
        make(most_m=0)  # type: ignore[operator]
    assert "check_check(Reach())" in check
    compile(used, "plugins.md", "exec")
    for name in re.findall(r"`(check_\w+|\w+_scene)(?:\(.*?\))?`", (ROOT / "docs" / "plugins.md").read_text()):
        assert hasattr(testing, name), name


def test_a_stage_that_breaks_the_rules_of_the_page_is_caught():
    class Listed:
        def keep(self, scene, target, grasps, gripper):
            return [True] * len(grasps)

    with pytest.raises(ContractError, match="must return ndarray, got list"):
        testing.check_check(Listed())


def test_the_readmes_python_runs(tmp_path, monkeypatch, capsys):
    from thinkgrasp.cameras.saving import save_frame

    save_frame(testing.sample_frame(), tmp_path)
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(ROOT / "README.md", "python")
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out.startswith("grasp ")


def test_every_kind_is_on_the_plugin_page():
    text = (ROOT / "docs" / "plugins.md").read_text()
    for kind in registry.KINDS:
        assert f"`thinkgrasp.{kind}`" in text
