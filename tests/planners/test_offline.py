"""What the planner takes, what it clears first, where it takes it, and what it says."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.household import HEIGHT, WIDTH, household, scene, thing
from hypothesis import given
from hypothesis import strategies as st

from thinkgrasp.errors import ConfigError
from thinkgrasp.interfaces import Planner
from thinkgrasp.memory import Attempt, Memory
from thinkgrasp.planners.offline import OfflinePlanner
from thinkgrasp.types import Grasp, Mask, Obstruction, Outcome, Proposal, Scene

TABLE = household()
BANANA = thing(1, (0, 0), (0.19, 0.04, 0.04), {"yellow": 0.9}, {"elongated": 0.9})
RED_BOX = thing(2, (0.02, 0.0), (0.16, 0.06, 0.10), {"red": 0.9}, {"box-like": 0.9}, raised=0.04)
WHITE_BALL = thing(3, (0.02, 0.0), (0.06, 0.06, 0.06), {"white": 0.95}, {"round": 0.9}, raised=0.14)


def rests(a: int, b: int) -> Obstruction:
    return Obstruction("rests_on", a, b, 0.0, "m")


def failed(proposal: Proposal, cell: int, times: int = 1) -> Memory:
    grasp = Grasp(np.eye(3), np.zeros(3), 0.05, 0.5)
    memory = Memory()
    for _ in range(times):
        memory = memory.remember(Attempt("it", cell, grasp, proposal.center_m, Outcome(False, "missed")))
    return memory


def plan(view: Scene, text: str, memory: Memory | None = None, **settings: int):
    return OfflinePlanner(**settings).plan(view, text, memory or Memory())  # pyright: ignore[reportArgumentType]


def test_it_is_a_planner() -> None:
    assert isinstance(OfflinePlanner(), Planner)


def test_a_free_goal_is_taken() -> None:
    p = plan(TABLE, "give me the red box")
    assert (p.found, p.role, p.mark, p.target) == (True, "goal", 3, "red box")
    assert "colour red" in p.rationale
    assert "Cell" in p.rationale
    assert p.degraded == ()


def test_all_things_are_listed_with_a_score_and_a_cell() -> None:
    p = plan(TABLE, "the banana")
    assert len(p.objects) == len(TABLE.proposals)
    assert p.objects[0].name == "banana"
    assert all(0 <= o.grasp_score <= 100 and o.cell is not None and 1 <= o.cell <= 9 for o in p.objects)


def test_what_rests_on_the_goal_goes_first() -> None:
    p = plan(scene([BANANA, RED_BOX], [rests(2, 1)]), "the banana")
    assert (p.role, p.mark) == ("obstruction", 2)
    assert "rests on banana" in p.rationale


def test_the_chain_is_followed_to_the_topmost_thing() -> None:
    p = plan(scene([BANANA, RED_BOX, WHITE_BALL], [rests(2, 1), rests(3, 2)]), "the banana")
    assert (p.role, p.mark) == ("obstruction", 3)


def test_a_cycle_of_edges_ends() -> None:
    edges = [rests(2, 1), rests(1, 2), rests(3, 2), rests(2, 3)]
    assert plan(scene([BANANA, RED_BOX, WHITE_BALL], edges), "the banana").mark == 3


def test_a_slight_occlusion_does_not_matter_and_a_heavy_one_does() -> None:
    area = int(BANANA.mask.sum())
    for pixels, mark in ((0.1 * area, 1), (3.0 * area, 2)):
        edges = [Obstruction("hides", 2, 1, pixels, "px")]
        assert plan(scene([BANANA, RED_BOX], edges), "the banana").mark == mark


def test_one_neighbour_leaves_the_other_sides_free_and_two_do_not() -> None:
    walls = [
        thing(m, at, (0.05, 0.05, 0.15), {"grey": 1.0}, {"box-like": 0.9})
        for m, at in ((2, (0, 0.05)), (3, (0, -0.05)))
    ]
    edges = [Obstruction("blocks", m, 1, 0.0, "m") for m in (2, 3)]
    assert plan(scene([BANANA, *walls], edges[:1]), "the banana").mark == 1
    assert plan(scene([BANANA, *walls], edges), "the banana").mark in (2, 3)


def test_what_could_not_be_removed_three_times_is_left() -> None:
    view = scene([BANANA, RED_BOX], [rests(2, 1)])
    assert plan(view, "the banana", failed(RED_BOX, 5, times=2)).mark == 2
    assert plan(view, "the banana", failed(RED_BOX, 5, times=3)).mark == 1


def test_of_two_that_fit_the_free_one_is_taken() -> None:
    apples = [thing(m, at, (0.07, 0.07, 0.07), {"red": 0.95}, {"round": 0.9}) for m, at in ((1, (0, 0)), (3, (0.2, 0)))]
    assert plan(scene([*apples, RED_BOX], [rests(2, 1)]), "an apple").mark == 3


def test_in_a_pile_what_may_hide_the_goal_goes_first() -> None:
    blocks = [thing(m, (0.1, 0.1 * m - 0.4), (0.09, 0.09, 0.04), {"blue": 0.9}, {"box-like": 0.9}) for m in (4, 5)]
    board = thing(6, (0.1, 0.2), (0.30, 0.30, 0.02), {"brown": 0.9}, {"flat": 0.9}, raised=0.04)
    p = plan(scene([RED_BOX, board, *blocks], [rests(2, 4), rests(6, 5), rests(2, 5)]), "the banana")
    assert (p.found, p.role, p.mark) == (True, "obstruction", 2)  # the highest, though the board is wider
    assert "most likely hides it" in p.rationale
    assert "pile" in p.rationale


def test_where_nothing_can_hide_the_goal_nothing_is_taken() -> None:
    p = plan(TABLE, "the grey elephant")
    assert not p.found
    assert p.mark is None
    assert "in view: " in p.rationale
    assert not p.rationale.endswith(".")
    remarked = plan(TABLE, "the frobnicated grey elephant").rationale
    assert remarked == f"{p.rationale}. Not understood: 'frobnicated'."


def test_which_of_several_is_said() -> None:
    assert ": number 2 leftmost 1.00" in plan(TABLE, "the second thing from the left").rationale
    assert ": leftmost 1.00" in plan(TABLE, "the leftmost thing").rationale


def test_a_pile_too_small_for_the_goal_is_left_alone() -> None:
    small = [
        thing(m, (0, 0), (0.03, 0.03, 0.02), {"blue": 0.9}, {"box-like": 0.9}, raised=z)
        for m, z in ((1, 0.0), (2, 0.02))
    ]
    view = scene(small, [rests(2, 1)])
    assert not plan(view, "the watermelon").found
    assert not plan(view, "the teddy bear").found


def test_behind_tall_things_only_when_asked_to_search_anywhere() -> None:
    view = scene([thing(1, (0, 0), (0.20, 0.08, 0.25), {"red": 0.9}, {"box-like": 0.9})])
    assert not plan(view, "the lemon").found
    p = OfflinePlanner(search="anywhere").plan(view, "the lemon", Memory())
    assert (p.role, p.mark) == ("obstruction", 1)
    assert not OfflinePlanner(search="anywhere").plan(view, "the watermelon", Memory()).found


def test_an_empty_scene_is_said() -> None:
    p = plan(scene([]), "the cup")
    assert not p.found
    assert p.rationale.startswith("no object proposals")


def test_words_that_are_not_understood_are_said() -> None:
    p = plan(TABLE, "xyzzy qwert")
    assert not p.found
    assert "'xyzzy', 'qwert'" in p.rationale
    assert "Not understood: 'frobnicated'" in plan(TABLE, "the frobnicated red box").rationale


def test_only_so_many_unknown_words_are_quoted() -> None:
    p = plan(TABLE, " ".join(f"qx{c}zv" for c in "abcdefghijklmnop"))
    assert "and 8 more" in p.rationale
    assert len(p.rationale) < 600


def bar(wide_left: bool) -> Mask:
    """A long thing whose one end is three times as wide as the other."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[235:245, 250:390] = True
    mask[225:255, slice(250, 300) if wide_left else slice(340, 390)] = True
    return mask


@pytest.mark.parametrize("wide_left", [True, False])
@pytest.mark.parametrize(("name", "by_wide_end"), [("knife", True), ("hammer", False), ("spoon", False)])
def test_tools_are_taken_by_the_safe_end(name: str, by_wide_end: bool, wide_left: bool) -> None:
    tool = thing(1, (0, 0), (0.2, 0.04, 0.02), {"grey": 0.9}, {"elongated": 0.9, "flat": 0.6}, mask=bar(wide_left))
    p = plan(scene([tool]), f"the {name}")
    column = (p.cell - 1) % 3
    assert column == (0 if wide_left == by_wide_end else 2)
    assert p.kind == "part"


def mug(handle: bool) -> Proposal:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    mask |= np.hypot(u - 320, v - 240) < 40
    if handle:
        mask |= (abs(np.hypot(u - 372, v - 240) - 18) < 5) & (u > 350)
    return thing(1, (0, 0), (0.12, 0.09, 0.09), {"red": 0.9}, {"cylindrical": 0.8, "hollow": 0.8}, mask=mask)


def test_the_handle_is_the_part_that_sticks_out() -> None:
    p = plan(scene([mug(handle=True)]), "the mug by its handle")
    assert p.kind == "part"
    assert p.cell == 6
    assert p.degraded == ()


def test_a_handle_that_is_not_in_view_is_a_degradation() -> None:
    p = plan(scene([mug(handle=False)]), "the mug by its handle")
    assert [d.stage for d in p.degraded] == ["plan"]
    assert "handle" in p.degraded[0].reason


def test_a_cell_that_failed_is_not_tried_again() -> None:
    first = plan(TABLE, "the banana").cell
    again = plan(TABLE, "the banana", failed(TABLE.proposal(6), first))
    assert again.mark == 6
    assert again.cell != first
    assert "failed" in again.rationale


def test_a_neighbour_drives_the_cell_to_the_free_side() -> None:
    box = thing(1, (0, 0), (0.20, 0.05, 0.05), {"red": 0.9}, {"box-like": 0.9})
    wall = thing(2, (0.04, 0), (0.05, 0.10, 0.15), {"grey": 0.9}, {"box-like": 0.9})
    beside = plan(scene([box, wall]), "the red box", grid=5).cell
    assert (beside - 1) % 5 < 2


@pytest.mark.parametrize("grid", [1, 2, 3, 4, 15])
def test_any_grid(grid: int) -> None:
    p = plan(TABLE, "the green bowl", grid=grid)
    assert p.grid == grid
    assert 1 <= p.cell <= grid * grid
    x0, y0, x1, y1 = TABLE.proposal(4).box_xyxy
    row, column = divmod(p.cell - 1, grid)
    cell = TABLE.proposal(4).mask[y0:y1, x0:x1]
    h, w = cell.shape
    part = cell[row * h // grid : -(-(row + 1) * h // grid), column * w // grid : -(-(column + 1) * w // grid)]
    assert part.any()


@pytest.mark.parametrize(
    "settings", [{"grid": 0}, {"grid": 99}, {"min_score": 0}, {"max_width_m": -1}, {"search": "x"}]
)
def test_settings_are_checked(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="offline planner"):
        OfflinePlanner(**settings)  # pyright: ignore[reportArgumentType]


def test_the_same_input_gives_the_same_plan() -> None:
    assert plan(TABLE, "something to eat") == plan(TABLE, "something to eat")


@given(st.text(max_size=120))
def test_any_text_gives_a_valid_plan(text: str) -> None:
    p = plan(TABLE, text)
    assert 1 <= p.cell <= 9
    assert p.rationale
    assert (p.mark in range(1, 11)) == p.found


@given(st.lists(st.tuples(st.sampled_from(["hides", "rests_on", "blocks"]), st.integers(1, 10), st.integers(1, 10))))
def test_any_graph_gives_a_valid_plan(edges: list[tuple[str, int, int]]) -> None:
    graph = [Obstruction(r, a, b, 0.0, "m") for r, a, b in edges]  # pyright: ignore[reportArgumentType]
    view = scene(TABLE.proposals, graph)
    for text in ("the banana", "the lemon"):
        p = plan(view, text)
        assert not p.found or p.mark in range(1, 11)
