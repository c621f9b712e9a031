"""Which thing of a hand-made household table is meant."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.household import household, scene, thing

from thinkgrasp.errors import ConfigError
from thinkgrasp.language.grounding import describe, ground, plain_names
from thinkgrasp.language.places import Layout
from thinkgrasp.language.query import parse
from thinkgrasp.language.weights import Weights
from thinkgrasp.types import Obstruction, Scene

NAVY_MUG, WHITE_MUG, CRACKERS, BOWL, SOUP, BANANA, MUSTARD, DRILL, APPLE, MARKER = range(1, 11)


@pytest.fixture(scope="module")
def table() -> Scene:
    return household()


def meant(table: Scene, text: str) -> int | None:
    fitting = ground(table, parse(text)).fitting()
    return fitting[0].mark if fitting else None


@pytest.mark.parametrize(
    ("text", "mark"),
    [
        ("the dark blue mug", NAVY_MUG),
        ("the white mug", WHITE_MUG),
        ("the red box", CRACKERS),
        ("the cracker box", CRACKERS),
        ("the green bowl", BOWL),
        ("a bowl", BOWL),
        ("the tomato soup can", SOUP),
        ("the red can", SOUP),
        ("the banana", BANANA),
        ("the yellow bottle", MUSTARD),
        ("the orange drill", DRILL),
        ("an apple", APPLE),
        ("a ball", APPLE),
        ("the black pen", MARKER),
        ("the purple or green bowl", BOWL),
        # by use, category and attribute
        ("something to write with", MARKER),
        ("a round object", APPLE),
        ("the red round one", APPLE),
        ("the biggest box", CRACKERS),
        # by place
        ("the cup on the left", NAVY_MUG),
        ("the mug on the right", WHITE_MUG),
        ("the rightmost mug", WHITE_MUG),
        ("the second from the left", NAVY_MUG),
        ("the leftmost object", MARKER),
        ("the cup next to the bowl", WHITE_MUG),
        ("the box behind the apple", CRACKERS),
        ("the one in front of the apple", BANANA),
        ("the mug left of the apple", WHITE_MUG),
        ("the mug but not the white one", NAVY_MUG),
    ],
)
def test_what_is_meant(table: Scene, text: str, mark: int) -> None:
    assert meant(table, text) == mark


@pytest.mark.parametrize(
    ("text", "marks"),
    [
        ("a fruit", {BANANA, APPLE}),
        ("something to eat", {BANANA, APPLE, CRACKERS, SOUP, MUSTARD}),
        ("something to drink from", {NAVY_MUG, WHITE_MUG}),
        ("something to hold other things", {NAVY_MUG, WHITE_MUG, BOWL}),
        ("a tool", {DRILL, MARKER}),
    ],
)
def test_any_of_several_may_be_meant(table: Scene, text: str, marks: set[int]) -> None:
    assert meant(table, text) in marks


@pytest.mark.parametrize(
    "text", ["the lemon", "a purple gizmo", "the grey elephant", "the phone", "a pink cup", "a spoon"]
)
def test_what_is_not_there_is_not_found(table: Scene, text: str) -> None:
    assert meant(table, text) is None


def test_every_proposal_gets_a_match_between_zero_and_one_best_first(table: Scene) -> None:
    matches = ground(table, parse("the red box or the banana")).matches
    scores = [m.score for m in matches]
    assert sorted(m.mark for m in matches) == list(range(1, 11))
    assert scores == sorted(scores, reverse=True)
    assert all(0 <= s <= 1 for s in scores)
    assert {m.mark for m in matches[:2]} == {CRACKERS, BANANA}


def test_reasons_carry_numbers(table: Scene) -> None:
    best = ground(table, parse("the red box")).matches[0]
    assert any(r.startswith("colour red 0.") for r in best.reasons)
    assert best.label == "red box"


def test_a_missing_landmark_is_noted_and_does_not_prevent_the_choice(table: Scene) -> None:
    grounding = ground(table, parse("the banana behind the elephant"))
    assert grounding.matches[0].mark == BANANA
    assert grounding.notes == ("no elephant in view to judge 'behind' by",)


def test_without_proposals_or_understanding_there_is_no_match(table: Scene) -> None:
    assert ground(scene([]), parse("the cup")).matches == ()
    assert ground(table, parse("xyzzy")).matches == ()


def test_only_sure_names_are_used_for_what_nobody_named(table: Scene) -> None:
    names = plain_names(table)
    assert names[BANANA] == "yellow banana"
    assert names[CRACKERS] == "red cracker box"
    assert names[BOWL] == "green round object"
    assert plain_names(scene([])) == {}


def test_describe_uses_colour_and_shape(table: Scene) -> None:
    assert describe(table.proposal(BANANA)) == "yellow elongated object"


def test_the_order_of_proposals_does_not_matter(table: Scene) -> None:
    turned = scene(table.proposals[::-1])
    for text in ("the mug on the left", "a fruit", "the one next to the bowl"):
        one, other = ground(table, parse(text)).matches, ground(turned, parse(text)).matches
        assert {m.mark: pytest.approx(m.score) for m in one} == {m.mark: m.score for m in other}


def cube(mark: int, at: tuple[float, float], **kwargs: float) -> object:
    return thing(mark, at, (0.05, 0.05, 0.05), {"grey": 1.0}, {"box-like": 1.0}, **kwargs)  # pyright: ignore[reportArgumentType]


def test_layout_axes_follow_the_view_and_the_table() -> None:
    layout = Layout.of(scene([cube(1, (0, 0)), cube(2, (0.2, 0)), cube(3, (0, 0.2))]))  # pyright: ignore[reportArgumentType]
    step = layout.position - layout.position[0]
    np.testing.assert_allclose(step[1], [0.2, 0, 0], atol=1e-9)
    np.testing.assert_allclose(step[2], [0, 0.2, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "best"),
    [("behind", 3), ("in front of", 4), ("left of", 5), ("right of", 2), ("on", 6)],
)
def test_relations(kind: str, best: int) -> None:
    around = {1: (0, 0), 2: (0.15, 0), 3: (0, 0.15), 4: (0, -0.15), 5: (-0.15, 0)}
    things = [cube(m, at) for m, at in around.items()] + [cube(6, (0, 0), raised=0.05)]
    view = scene(things, [Obstruction("rests_on", 6, 1, 0.0, "m")])  # pyright: ignore[reportArgumentType]
    degree = Layout.of(view).relation_degree(kind, 0)
    assert int(degree.argmax()) + 1 == best
    assert degree[0] == 0


def test_under_is_the_reverse_of_on() -> None:
    view = scene([cube(1, (0, 0)), cube(2, (0, 0), raised=0.05), cube(3, (0.2, 0))])  # pyright: ignore[reportArgumentType]
    assert int(Layout.of(view).relation_degree("under", 1).argmax()) == 0


def test_between() -> None:
    view = scene([cube(1, (-0.2, 0)), cube(2, (0.2, 0)), cube(3, (0.02, 0.01)), cube(4, (0.3, 0.2))])  # pyright: ignore[reportArgumentType]
    assert int(Layout.of(view).between_degree(0, 1).argmax()) == 2


@pytest.mark.parametrize(
    "absent",
    [
        "a pineapple",
        "a hammer",
        "a lemon",
        "an orange",
        "a pear",
        "a spoon",
        "a fork",
        "scissors",
        "a stapler",
        "a computer mouse",
        "a phone",
        "a plate",
        "a wine glass",
        "the purple mug",
        "the green apple",
    ],
)
def test_what_is_not_there_is_not_accepted(table: Scene, absent: str) -> None:
    assert ground(table, parse(absent)).fitting() == ()


def test_a_thin_long_thing_is_a_spoon_and_a_thick_one_is_not() -> None:
    spoon = thing(1, (0, 0), (0.18, 0.04, 0.02), {"grey": 0.9}, {"elongated": 1.0})
    figure = thing(2, (0.2, 0), (0.12, 0.08, 0.06), {"grey": 0.9}, {})
    matches = ground(scene([spoon, figure]), parse("a spoon")).fitting()
    assert [m.mark for m in matches] == [1]


def test_what_lies_does_not_stand_on_its_end() -> None:
    lying = thing(1, (0, 0), (0.1, 0.06, 0.035), {"black": 0.9}, {"box-like": 0.6, "round": 0.4})
    standing = thing(2, (0.2, 0), (0.04, 0.06, 0.1), {"black": 0.9}, {"box-like": 0.6, "round": 0.4})
    best = ground(scene([lying, standing]), parse("a computer mouse")).matches
    assert best[0].mark == 1
    assert best[0].score > 1.8 * best[1].score


def test_a_name_without_features_is_left_to_what_nothing_else_explains(table: Scene) -> None:
    grounding = ground(table, parse("the glove"))
    assert grounding.fitting() == ()
    assert "neither a colour nor a shape is usual for 'glove'" in grounding.notes[0]
    odd = thing(11, (0.4, 0.3), (0.2, 0.12, 0.05), {"pink": 0.5, "green": 0.5}, {})
    assert [m.mark for m in ground(scene([*table.proposals, odd]), parse("the glove")).fitting()] == [11]
    assert ground(table, parse("the blue glove")).notes == ()


def test_a_colour_that_was_said_must_hold(table: Scene) -> None:
    strict, mild = Weights(said_color=0.9), Weights(said_color=0.0)
    query = parse("the brown banana")
    score = {w: next(m.score for m in ground(table, query, w).matches if m.mark == BANANA) for w in (strict, mild)}
    assert score[strict] < 0.6 * score[mild]


def test_weights_must_be_finite_and_not_negative() -> None:
    with pytest.raises(ConfigError, match="rivalry"):
        Weights(rivalry=-1.0)
    with pytest.raises(ConfigError, match="min_score"):
        Weights(min_score=float("nan"))
