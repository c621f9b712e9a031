"""The household knowledge: complete, consistent, and reachable by the words people use."""

from __future__ import annotations

import pytest

from thinkgrasp.errors import ConfigError
from thinkgrasp.language.grounding import candidates
from thinkgrasp.language.knowledge import load_knowledge, parse_knowledge
from thinkgrasp.language.query import parse
from thinkgrasp.language.vocabulary import load_vocabulary, stem

YCB = """chips can, master chef can, cracker box, sugar box, tomato soup can, mustard bottle, tuna fish can, pudding
box, gelatin box, potted meat can, banana, strawberry, apple, lemon, peach, pear, orange, plum, pitcher base,
bleach cleanser, windex bottle, wine glass, bowl, mug, sponge, skillet, skillet lid, plate, fork, spoon,
knife, spatula, power drill, wood block, scissors, padlock, large marker, small marker, adjustable wrench,
phillips screwdriver, flat screwdriver, hammer, medium clamp, large clamp, extra large clamp, mini soccer
ball, softball, baseball, tennis ball, racquetball, golf ball, chain, foam brick, dice, marbles, cups, colored
wood blocks, toy airplane, lego duplo, timer, rubiks cube"""
GRASPNET = """cracker box, sugar box, tomato soup can, mustard bottle, potted meat can, banana, bowl, mug, power drill,
scissors, chips can, strawberry, apple, lemon, peach, pear, orange, plum, knife, phillips screwdriver, flat
screwdriver, racquetball, b cups, d cups, a toy airplane, c toy airplane, foam brick, dabao wash soup,
nzskincare mouth rinse, dabao sod, soap box, kispa cleanser, darlie toothpaste, nivea men oil control, baoke
marker, pitcher cap, dish, white mouse, camel, deer, zebra, large elephant, rhinoceros, small elephant,
monkey, giraffe, gorilla, weiquan, darlie box, soap, black mouse, dabao facewash, pantene, head shoulders
supreme, thera med, dove, head shoulders care, lion, coca cola, hippo, tape"""


def test_there_are_enough_objects_of_many_kinds() -> None:
    knowledge = load_knowledge()
    assert len(knowledge.objects) >= 220
    assert len(knowledge.categories) >= 20
    assert len(knowledge.uses) >= 25


@pytest.mark.parametrize("name", [n.strip() for n in f"{YCB},{GRASPNET}".replace("\n", " ").split(",")])
def test_the_objects_of_the_known_sets_are_understood(name: str) -> None:
    assert candidates(parse(f"give me the {name}").wanted[0])


def test_every_name_and_synonym_is_read_back_as_its_object() -> None:
    for obj in load_knowledge().objects.values():
        for word in (obj.name, *obj.synonyms):
            phrase = tuple(stem(w) for w in word.replace("-", " ").replace("_", " ").split())
            assert "name" in load_vocabulary().phrases[phrase]
        assert parse(obj.name).wanted[0].names == (obj.name,) or "color" in load_vocabulary().phrases[(stem(obj.name),)]


def test_every_said_use_and_category_is_served_by_some_object() -> None:
    knowledge = load_knowledge()
    for senses in load_vocabulary().phrases.values():
        if "use" in senses:
            assert senses["use"] in knowledge.uses
        if "category" in senses:
            assert senses["category"] in knowledge.categories


def test_kinds_of_a_general_name() -> None:
    knowledge = load_knowledge()
    assert {"can", "tomato soup can", "tuna can"} <= knowledge.kinds_of("can")
    assert {"ball", "softball", "tennis ball"} <= knowledge.kinds_of("ball")
    assert knowledge.kinds_of("banana") == {"banana"}


def test_parts() -> None:
    knife = load_knowledge().objects["knife"]
    handle, blade = knife.part("handle"), knife.part("blade")
    assert handle in knife.take
    assert blade in knife.avoid
    assert knife.part("lid") is None


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (["x", "", "mauve", "", [1, 2], [1, 2]], "unknown colour 'mauve'"),
        (["x", "", "", "pointy", [1, 2], [1, 2]], "unknown shape 'pointy'"),
        (["x", "", "", "", [2, 1], [1, 2]], "must be ordered"),
        (["x", "", "", "", [1, 2], [5, 6]], "exceeds the longest"),
        (["x", "", "", "", [1, 2], [1, 2], {"take": ["handle"]}], "name@place"),
        (["x", "", ""], "6 or 7 entries"),
    ],
)
def test_bad_rows_are_named(row: list[object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_knowledge({"group": {"rows": [row]}})


def test_a_name_must_not_occur_twice() -> None:
    row = ["x", "", "", "", [1, 2], [1, 2]]
    with pytest.raises(ConfigError, match="occurs twice"):
        parse_knowledge({"group": {"rows": [row, row]}})


def test_commonness_must_name_known_objects() -> None:
    row = ["mug", "", "", "hollow", [80, 145], [65, 105]]
    with pytest.raises(ConfigError, match="commonness names unknown objects: mugg"):
        parse_knowledge({"commonness": {"everywhere": ["mugg"]}, "drinkware": {"rows": [row]}})
    known = parse_knowledge({"commonness": {"seldom": ["mug"]}, "drinkware": {"rows": [row]}})
    assert known.objects["mug"].common < 0.8


def test_the_middle_side_follows_from_roundness_unless_said() -> None:
    rows = [
        ["can", "", "", "cylindrical", [50, 250], [35, 120]],
        ["mug", "", "", "hollow", [80, 145], [65, 105], {"middle": [65, 115]}],
        ["bag", "", "", "", [80, 450], [15, 250]],
    ]
    objects = parse_knowledge({"things": {"rows": rows}}).objects
    assert objects["can"].middle_m == pytest.approx((0.035, 0.156))
    assert objects["mug"].middle_m == pytest.approx((0.065, 0.115))
    assert objects["bag"].middle_m == pytest.approx((0.015, 0.45))
