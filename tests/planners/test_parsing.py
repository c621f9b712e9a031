"""Replies of models, good, odd and useless: each gives the plan it means, or an error that quotes it."""

from __future__ import annotations

import json
import time
import tomllib
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from thinkgrasp.planners.parsing import PlanParseError, parse_reply
from thinkgrasp.types import Plan

REPLIES = tomllib.loads((Path(__file__).parents[1] / "data" / "vlm_replies.toml").read_text("utf-8"))["reply"]
WH = (224, 224)
FIELDS = ("target", "kind", "role", "mark", "cell", "found", "rationale")
GOOD = [r["text"] for r in REPLIES if "error" not in r]


def checked(text: str, grid: int = 3, wh: tuple[int, int] = WH) -> Plan | None:
    """The plan, which keeps every promise, or None where the reply is refused as it should be."""
    plan: Plan | str
    try:
        plan = parse_reply(text, grid=grid, image_wh=wh)
    except PlanParseError as error:
        plan = str(error)
    if isinstance(plan, str):
        assert plan.isprintable()
        assert len(plan) < 300
        return None
    assert 1 <= plan.cell <= grid * grid
    assert plan.grid == grid
    assert plan.found == bool(plan.target)
    assert plan.mark is None or plan.mark > 0
    if plan.crop_xyxy is not None:
        x0, y0, x1, y1 = plan.crop_xyxy
        assert 0 <= x0 < x1 <= wh[0]
        assert 0 <= y0 < y1 <= wh[1]
    if plan.point_px is not None:
        assert 0 <= plan.point_px[0] < wh[0]
        assert 0 <= plan.point_px[1] < wh[1]
    for o in plan.objects:
        assert 0 <= o.grasp_score <= 100
        assert o.cell is None or 1 <= o.cell <= grid * grid
    for words in (plan.target, plan.rationale, *(o.name for o in plan.objects)):
        assert words == words.encode("utf-8", "replace").decode("utf-8")
        assert "\n" not in words
    return plan


def test_there_are_enough_replies():
    assert len(REPLIES) >= 80
    assert len({r["name"] for r in REPLIES}) == len(REPLIES)


@pytest.mark.parametrize("reply", REPLIES, ids=[r["name"] for r in REPLIES])
def test_a_reply_is_read_as_it_is_meant(reply):
    grid = reply.get("grid", 3)
    if "error" in reply:
        with pytest.raises(PlanParseError, match=reply["error"]):
            parse_reply(reply["text"], grid=grid, image_wh=WH)
        return
    plan = checked(reply["text"], grid)
    assert plan is not None
    assert {f: getattr(plan, f) for f in FIELDS if f in reply} == {f: reply[f] for f in FIELDS if f in reply}
    if "box" in reply:
        assert plan.crop_xyxy == tuple(reply["box"])
    if "objects" in reply:
        assert [[o.name, o.grasp_score, o.cell or 0] for o in plan.objects] == reply["objects"]


@pytest.mark.parametrize(
    ("said", "point"),
    [
        ("Grasp pixel: (120, 85)", (120, 85)),
        ("**Grasp Pixel:** [120.6, 85.2]", (120, 85)),
        ("- grasping pixel = x: 120, y: 85 (on its rim)", (120, 85)),
        ("Pixel coordinates: 120,85", (120, 85)),
        ("Grasp pixel: (0.5, 0.25)", (112, 56)),
        ("Grasp pixel: 50%, 25%", (112, 56)),
        ("Grasp pixel: (224, 224)", (223, 223)),
        ("Grasp pixel: （120，85）", (120, 85)),
        ("Grasp pixel: (1, 1)", (1, 1)),
        ("Grasp pixel: (120, ", None),
        ("Grasp pixel: none", None),
        ("", None),
    ],
)
def test_a_pixel(said, point):
    assert parse_reply(f"Goal visible: yes\nSelected object: red mug\n{said}", image_wh=WH).point_px == point


def test_a_pixel_in_json():
    assert parse_reply('{"target": "mug", "grasp_pixel": {"x": 3, "y": 4}}', image_wh=WH).point_px == (3, 4)


@pytest.mark.parametrize("said", ["(1, 2, 3)", "(300, 4)", "(-5, 4)", "120"])
def test_a_pixel_that_is_none_is_quoted(said):
    with pytest.raises(PlanParseError, match="pixel") as error:
        parse_reply(f"Selected object: red mug\nGrasp pixel: {said}\nDone.", image_wh=WH)
    assert said in str(error.value)


def test_an_error_quotes_the_place():
    with pytest.raises(PlanParseError, match=r"the cell '12' lies outside 1\.\.9 of the 3x3 grid"):
        parse_reply('{"target": "mug", "cell": 12}', image_wh=WH)
    with pytest.raises(PlanParseError, match="I'm sorry, I can't help"):
        parse_reply("I'm sorry, I can't help", image_wh=WH)


@given(st.text(max_size=300))
@example("{'target':\ud800'")
def test_any_text(text):
    checked(text)


PIECES = st.sampled_from(
    [
        *("Selected object", "Object", "Cropping box", "Grasp score", "Preferred cell", "Mark", "part", "none", "mug"),
        *("{", "}", "[", "]", "(", ")", '"', "'", ":", ",", ";", "\n", " ", "|", "\\", "\\u12", "//", "/*", "<think>"),
        *("target", '"target"', '"cell"', '"mark"', "objects", "null", "true", "1e999", "-1", "0.5", "9" * 400, "５"),
        *("top-left", "row 1 column", "85/100", "/0", "%", "\ud800", "\x00", "\u202e", "【", "：", "²", "٣", "half"),
    ]
)


@given(st.lists(PIECES, max_size=60).map("".join), st.integers(1, 5))
def test_any_mixture_of_the_formats(text, grid):
    checked(text, grid, (640, 480))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["target", "mark", "cell", "box", "objects", "name", "score", "role"]), inner)
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from(["target", "mark", "cell", "box", "objects", "kind", "visible"]), JSON))
def test_any_json(value):
    checked(json.dumps(value))


@given(st.sampled_from(GOOD), st.data())
def test_good_replies_with_pieces_cut_doubled_or_replaced(text, data):
    for _ in range(data.draw(st.integers(1, 4))):
        i, j = sorted(data.draw(st.tuples(st.integers(0, len(text)), st.integers(0, len(text)))))
        text = text[:i] + data.draw(st.sampled_from(["", text[i:j] * 2, data.draw(PIECES)])) + text[j:]
    checked(text[:5000])


@pytest.mark.parametrize("text", GOOD, ids=[r["name"] for r in REPLIES if "error" not in r])
def test_good_replies_cut_off_anywhere(text):
    for end in range(0, len(text), max(1, len(text) // 24)):
        checked(text[:end])


@given(st.text(max_size=60), st.integers(1, 9), st.integers(0, 100))
def test_what_is_written_as_json_is_read_back(name, cell, score):
    text = json.dumps(
        {"target": "mug", "cell": cell, "objects": [{"name": "mug", "grasp_score": score}], "rationale": name}
    )
    plan = checked(text)
    assert plan is not None
    assert (plan.target, plan.cell) == ("mug", cell)
    assert [o.grasp_score for o in plan.objects] == [score]


@pytest.mark.parametrize(
    "text",
    [
        "x" * 10_000_000,
        "{" * 10_000_000,
        "<think>" * 1_000_000,
        '{"target": "' * 800_000,
        '{"target": "mug", "rationale": "' + "a\\" * 5_000_000,
        "Selected object: " + "," * 10_000_000,
        "Selected object: mug\n" + "- mug: grasp score 80, preferred cell 2\n" * 200_000,
        "Selected object: mug\n" + "(" * 1_000_000 + "score",
        "| " * 1_000_000,
        "object " * 1_000_000,
        "* " * 1_000_000,
    ],
    ids=lambda t: t[:40].strip(),
)
def test_ten_megabytes_are_no_work(text):
    start = time.process_time()
    checked(text)
    assert time.process_time() - start < 3
