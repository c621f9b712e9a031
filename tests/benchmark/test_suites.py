from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from thinkgrasp.benchmark.suites import SuiteSource, load_suite
from thinkgrasp.errors import ConfigError, InputError

SHARED = Path(__file__).resolve().parents[3] / "shared"
needs_cases = pytest.mark.skipif(not (SHARED / "paper_cases").is_dir(), reason="needs ../shared/paper_cases")
LAYOUT = "give me the pear\n0\nassets/simplified_objects/015.urdf 0.5 0.0 0.1 0 0 0\n"


@pytest.mark.parametrize(("name", "n", "limit"), [("clutter-v1", 10, 15), ("heavy-v1", 6, 50)])
def test_our_suites_are_the_papers_tasks(name, n, limit):
    cases = load_suite(SuiteSource(name))
    assert len(cases) == n
    assert {case.step_limit for case in cases} == {limit}


@needs_cases
@pytest.mark.parametrize(
    ("name", "folder", "n", "limit"),
    [("paper-clutter", "testing_cases", 10, 15), ("paper-heavy", "heavy_unseen", 6, 50)],
)
def test_published_layouts_are_suites_too(name, folder, n, limit):
    cases = load_suite(SuiteSource(name, SHARED / "paper_cases" / folder))
    assert (len(cases), {case.step_limit for case in cases}) == (n, {limit})
    assert cases[0].name == "case00-round"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cluter",), "no suite 'cluter'; allowed: clutter, heavy, clutter-v1"),
        (("paper-clutter",), "add --cases DIR"),
        (("clutter-v1", Path("cases")), "leave out --cases"),
        (("heavy-v1", None, Path("objects")), "leave out --objects"),
    ],
)
def test_what_is_no_suite_is_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        SuiteSource(*arguments)


def write_box(folder: Path) -> None:
    folder.mkdir(parents=True)
    box = '<geometry><box size="0.05 0.05 0.05"/></geometry>'
    (folder / "model.urdf").write_text(
        f'<robot name="x"><link name="a"><inertial><mass value="0.1"/></inertial>'
        f"<visual>{box}</visual><collision>{box}</collision></link></robot>"
    )


def test_real_objects_take_the_place_of_stand_ins(tmp_path):
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "case00-pear.txt").write_text(LAYOUT)
    write_box(tmp_path / "own" / "015")
    (case,) = load_suite(SuiteSource("paper-clutter", tmp_path / "cases", tmp_path / "own"))
    assert case.scene(0).spec.objects[0].source == str(tmp_path / "own" / "015")
    (case,) = load_suite(SuiteSource("paper-clutter", tmp_path / "cases"))
    assert case.scene(0).spec.objects[0].source != str(tmp_path / "own" / "015")


def test_objects_of_which_none_is_published_are_refused(tmp_path):
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "case00-pear.txt").write_text(LAYOUT)
    write_box(tmp_path / "own" / "mug")
    with pytest.raises(InputError, match=r"no folder is named by a published id of .* such as '015'; found mug"):
        load_suite(SuiteSource("paper-clutter", tmp_path / "cases", tmp_path / "own"))
