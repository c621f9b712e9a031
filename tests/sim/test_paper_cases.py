"""The published layouts, read with catalogue objects of the same kind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thinkgrasp.errors import InputError
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.goals import goals_in
from thinkgrasp.sim.paper_cases import list_cases, load_case, published_names

CASES = Path(__file__).parents[3] / "shared" / "paper_cases"
published = pytest.mark.skipif(not CASES.is_dir(), reason=f"no published layouts at {CASES}")

GOOD = """\
give me the pear
1
assets/simplified_objects/005.urdf 0.5 -0.1 0.2 0.3 -0.5 1.2
assets/simplified_objects/015.urdf 0.4 0.1 0.2 0 0 0

assets/simplified_objects/005.urdf 0.4 0.1 0.2 0 0 0
"""


def layout_file(tmp_path: Path, text: str = GOOD) -> Path:
    path = tmp_path / "case.txt"
    path.write_text(text)
    return path


def test_a_layout(tmp_path):
    layout = load_case(layout_file(tmp_path))
    assert (layout.name, layout.instruction, layout.goals) == ("case", "give me the pear", (1,))
    assert layout.names == ("banana", "pear", "banana")
    R = Rotation.from_euler("z", 1.2) * Rotation.from_euler("y", -0.5) * Rotation.from_euler("x", 0.3)
    assert np.allclose(layout.poses[0][:3, :3], R.as_matrix())
    assert np.allclose(layout.poses[:, :3, 3], [[0.5, -0.1, 0.2], [0.4, 0.1, 0.2], [0.4, 0.1, 0.2]])


def test_its_objects_may_be_replaced_by_real_ones(tmp_path):
    layout = load_case(layout_file(tmp_path))
    real = replace(catalogue.make("banana"), name="my banana")
    assert [o.name for o in layout.objects(own={"005": real})] == ["my banana", "pear", "my banana"]
    assert [o.name for o in layout.objects(own={"simplified_objects/015": real})] == ["banana", "my banana", "banana"]
    with pytest.raises(InputError, match="has no object '099'; it has simplified_objects/005, simplified_objects/015"):
        layout.objects(own={"099": real})


def test_every_published_object_has_a_counterpart():
    assert set(published_names()) <= set(catalogue.names())


@published
def test_all_published_layouts():
    layouts = [load_case(path) for path in list_cases(CASES)]
    assert len(layouts) == 16
    assert [len(x.names) for x in layouts] == [30] * 6 + [15, 15, 14] + [15] * 7
    assert sum(len(x.goals) for x in layouts) == 6 + 16
    for layout in layouts:
        assert layout.poses.shape == (len(layout.names), 4, 4)
        assert (layout.poses[:, :2, 3].min(axis=0) > [0.27, -0.23]).all()


@published
@pytest.mark.parametrize("path", list_cases(CASES) if CASES.is_dir() else [], ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_published_goals_serve_their_instruction(path):
    layout = load_case(path)
    assert set(layout.goals) <= set(goals_in(layout.instruction, layout.objects()))


BAD = {
    "empty": ("", "1: the instruction is missing"),
    "blank instruction": (GOOD.replace("give me the pear", " "), "1: the instruction is missing"),
    "no objects": ("give me the pear\n0\n", "2: no objects"),
    "goals in words": (GOOD.replace("\n1\n", "\none\n"), "2: the goals must be whole numbers .* got 'one'"),
    "no goals": (GOOD.replace("\n1\n", "\n\n"), "2: no goals"),
    "goal too high": (GOOD.replace("\n1\n", "\n3\n"), "2: goal 3 is no object; there are 3, from 0 to 2"),
    "negative goal": (GOOD.replace("\n1\n", "\n-1\n"), "2: goal -1 is no object"),
    "goal twice": (GOOD.replace("\n1\n", "\n1 1\n"), "2: a goal occurs twice"),
    "too few numbers": (GOOD.replace(" 0.3 -0.5 1.2", ""), "3: an object is .* 7 words, got 4"),
    "words for numbers": (GOOD.replace("1.2", "north"), "3: x y z roll pitch yaw must be 6 finite numbers"),
    "nan": (GOOD.replace("1.2", "nan"), "3: .* must be 6 finite numbers"),
    "millimetres": (GOOD.replace("0.5 -0.1 0.2", "500 -100 200"), "3: a position must lie within 2.0 m"),
    "unknown object": (
        GOOD.replace("015.urdf", "15.urdf"),
        "4: .* is none of the 84 published .* did you mean simplified_objects/015",
    ),
    "no urdf": (GOOD.replace("015.urdf", "015.obj"), "4: .* is none of"),
    "bad last line": (f"{GOOD}\nx", "8: an object is"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_layout_is_refused_with_its_line(tmp_path, case):
    text, expected = BAD[case]
    with pytest.raises(InputError, match=rf"case\.txt:{expected}"):
        load_case(layout_file(tmp_path, text))


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_case(tmp_path / "case.txt")
    with pytest.raises(InputError, match="holds no layouts"):
        list_cases(tmp_path)
