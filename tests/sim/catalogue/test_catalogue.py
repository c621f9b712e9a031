"""The catalogue: enough things, known by name, that look, weigh and collide as they should."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator's packages are not installed (extra: sim)")
pytest.importorskip("trimesh", reason="the simulator's packages are not installed (extra: sim)")

from sim.catalogue.distances import outside_surface, surface_points, to_piece

from thinkgrasp.errors import ConfigError
from thinkgrasp.geometry import make_transform
from thinkgrasp.language.grounding import candidates
from thinkgrasp.language.knowledge import load_knowledge
from thinkgrasp.language.query import parse
from thinkgrasp.perception.color import lab_from_rgb, name_colors
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.catalogue import _FAMILIES, _UNSEEN, make, names, split
from thinkgrasp.sim.catalogue.sheet import contact_sheet, picture
from thinkgrasp.sim.objects import SimObject
from thinkgrasp.sim.world import World

HEAVY = """black marker|red marker|bleach cleanser|blue moon|gelatin box|magic clean|pink tea box|remote control|
repellent|shampoo bottle|small clamp|soap dish|sugar box|white sugar box|two color hammer|yellow bowl|yellow cup|
softball|tennis ball|red backpack|white ball|blue ball|battery|mango""".replace("\n", "").split("|")
CLUTTER = """tomato soup can|banana|bowl|mug|power drill|scissors|strawberry|apple|lemon|peach|pear|orange|plum|knife|
flat screwdriver|racquetball|blue cup|toy airplane|blue toy airplane|padlock|lotion bottle|mouth rinse|face wash|
facial cleanser|toothpaste tube|toothpaste box|thera med|marker|pitcher lid|white computer mouse|black computer mouse|
rhinoceros|elephant|lion|gorilla|camel|soda can|soap|shampoo|juice box|tape|peeler|ice cube mould|bar clamp|gearbox|
machine part|pawn|pipe connector|turbine housing|vase""".replace("\n", "").split("|")

SIZE_SLACK = 0.05
TOY_SIZED = {"softball": 0.16}
"""Smaller than the real thing, so that a gripper of 85 mm can take it."""

SEEN_NOT_TOUCHED = {"stalk", "leaf", "eye", "buttons", "screen"}
"""Parts too thin or soft to collide."""
MATCH_M = 0.0027
LOOSE_M = {"banana": 0.004, "cucumber": 0.004}
"""Capsules have one radius: they stand over the tapering ends."""

TAKEN_BY = {"rim", "handle", "neck", "core", "nose"}
"""Parts whose presence means that there is something narrow to close on: a wall, a grip, a slim fuselage."""

catalogue_names = pytest.mark.parametrize("name", names())


@pytest.fixture(scope="module")
def objects() -> dict[str, SimObject]:
    return {name: make(name) for name in names()}


def test_there_are_enough_things_of_many_kinds_and_no_name_twice() -> None:
    assert len(names()) >= 70
    assert len(catalogue.categories()) >= 20
    assert len(names()) == sum(len(family.ENTRIES) for family in _FAMILIES)


def test_the_split_is_a_partition_that_follows_the_published_suites() -> None:
    seen, unseen = set(split("seen")), set(split("unseen"))
    assert seen | unseen == set(names())
    assert not seen & unseen
    assert set(_UNSEEN) == unseen
    assert set(HEAVY) <= unseen
    assert set(CLUTTER) <= seen


def test_a_seed_gives_the_same_bits_and_another_seed_another_thing() -> None:
    for name in ("tomato soup can", "mug", "sponge"):
        one, same, other = make(name, 3), make(name, 3), make(name, 4)
        for a, b in zip(one.visuals, same.visuals, strict=True):
            assert a.vertices.tobytes() == b.vertices.tobytes()
            assert a.color == b.color
            assert (a.texture is None) == (b.texture is None)
            if a.texture and b.texture:
                assert a.texture.image.tobytes() == b.texture.image.tobytes()
        assert one.mass_kg == same.mass_kg != other.mass_kg
        assert not np.array_equal(one.bounds_m, other.bounds_m)


def test_an_unknown_name_is_answered_with_a_close_one() -> None:
    with pytest.raises(ConfigError, match="did you mean 'banana'"):
        make("bananna")


def test_an_unknown_split_is_refused() -> None:
    with pytest.raises(ConfigError, match="'seen' and 'unseen'"):
        split("test")  # pyright: ignore[reportArgumentType]


def test_the_instruction_of_the_published_case_finds_its_object() -> None:
    found = candidates(parse("give me the thera_med").wanted[0])
    kinds = [o.name for o in load_knowledge().objects.values() if "thera med" in o.synonyms]
    assert kinds[0] in str(found)


@catalogue_names
def test_words_and_sizes_agree_with_the_household_knowledge(name: str) -> None:
    entry = next(e for family in _FAMILIES for e in family.ENTRIES if e.name == name)
    known, slack = entry.known, TOY_SIZED.get(name, SIZE_SLACK)
    for seed in range(3):
        obj = make(name, seed)
        sides = np.sort(np.diff(obj.bounds_m, axis=0)[0])
        assert known.shortest_m[0] * (1 - slack) <= sides[0] <= known.shortest_m[1] * (1 + slack)
        assert known.longest_m[0] * (1 - slack) <= sides[2] <= known.longest_m[1] * (1 + slack)
        assert sides[2] <= 0.23
        assert obj.category in known.categories
        assert obj.uses == known.uses
        assert not known.colors or obj.colors[0] in known.colors
        assert 0.01 <= obj.mass_kg <= 0.8
        assert 0.5 <= obj.friction <= 0.9


@catalogue_names
def test_it_is_small_enough_to_compute_with_and_closed(name: str, objects: dict[str, SimObject]) -> None:
    obj = objects[name]
    assert sum(len(v.faces) for v in obj.visuals) <= 1000
    assert len(obj.collisions) <= 40
    assert all(c.points_m is None or len(c.points_m) <= 24 for c in obj.collisions)
    for piece in obj.visuals:
        edges = np.concatenate([piece.faces[:, [0, 1]], piece.faces[:, [1, 2]], piece.faces[:, [2, 0]]])
        once = set(map(tuple, edges.tolist()))
        assert len(once) == len(edges), "an edge is used twice in one direction"
        assert {(b, a) for a, b in once} == once, "an edge has a face on one side only"
        a, b, c = (piece.vertices[piece.faces[:, i]].astype(float) for i in range(3))
        assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0, "faces look inwards"


@catalogue_names
def test_what_collides_is_what_is_seen(name: str, objects: dict[str, SimObject]) -> None:
    obj, allowed = objects[name], LOOSE_M.get(name, MATCH_M)
    for piece in obj.visuals:
        points = np.concatenate([piece.vertices, piece.vertices[piece.faces].mean(axis=1)]).astype(np.float64)
        over = np.min([to_piece(c, points) for c in obj.collisions], axis=0).max()
        assert over <= (0.01 if piece.part in SEEN_NOT_TOUCHED else allowed), piece.part
    touched = np.concatenate([surface_points(c) for c in obj.collisions])
    assert outside_surface(obj, touched[:: max(1, len(touched) // 150)]).max() <= allowed


@catalogue_names
def test_a_gripper_of_85_mm_can_take_it(name: str, objects: dict[str, SimObject]) -> None:
    obj = objects[name]
    x, y, _ = np.diff(obj.bounds_m, axis=0)[0]
    assert min(x, y) <= 0.082 or TAKEN_BY & set(obj.parts)


@catalogue_names
def test_its_first_colour_is_what_most_of_it_shows(name: str, objects: dict[str, SimObject]) -> None:
    obj = objects[name]
    pixels = [color[mask] for color, mask in (picture(obj, 56, view=view) for view in ("front", "back"))]
    shares = dict(name_colors(lab_from_rgb(np.concatenate(pixels))))
    if obj.colors[0] == "white":
        shares["white"] = shares.get("white", 0.0) + shares.pop("grey", 0.0)  # white in the shade
    assert max(shares, key=lambda color: shares[color]) == obj.colors[0], shares
    assert all(shares.get(color, 0.0) >= 0.07 for color in obj.colors), shares


@catalogue_names
def test_it_drops_and_comes_to_rest(name: str, objects: dict[str, SimObject]) -> None:
    obj = objects[name]
    world = World([obj], robot=False)
    world.place(0, make_transform(np.eye(3), np.array([0.5, 0.0, 0.05 - obj.bounds_m[0, 2]])))
    assert world.settle(max_seconds=4.0)
    position = world.pose(0)[:3, 3]
    assert np.linalg.norm(position[:2] - [0.5, 0.0]) < 0.2
    assert 0.0 < position[2] < 0.15


def test_vessels_are_hollow() -> None:
    for name in ("mug", "blue cup", "bowl", "vase", "soap dish", "tape"):
        obj = make(name)
        inside = np.array([[0.0, 0.0, obj.bounds_m[1, 2] - 0.01]])
        assert min(to_piece(c, inside)[0] for c in obj.collisions) > 0.008, name


def test_the_sheet_has_a_tile_for_each() -> None:
    one = contact_sheet([make("mug")])
    assert len(np.unique(np.asarray(one))) > 20
