"""The rule of objects and parts as a table: what succeeds, what fails, what comes out and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from thinkgrasp.errors import ConfigError, ContractError
from thinkgrasp.interfaces import Segmenter
from thinkgrasp.segmenters.boxes import segment_of
from thinkgrasp.segmenters.cascade import CascadeSegmenter
from thinkgrasp.segmenters.geometric import GeometricSegmenter
from thinkgrasp.testing import sample_scene, strict_scene
from thinkgrasp.types import Degradation, Plan, PlannedObject, Scene, Segment, Segmentation

H, W = 240, 320
MUG, MUG_2, CUT, HANDLE = (40, 60, 120, 160), (200, 60, 260, 160), (0, 60, 50, 160), (110, 90, 130, 130)


@dataclass
class Scripted:
    """A segmenter that knows some names: boxes with scores, in the whole image or (by `crop`) in a smaller one."""

    whole: dict[str, list[tuple[tuple[int, int, int, int], float]]] = field(default_factory=dict)
    crop: dict[str, list[tuple[tuple[int, int, int, int], float]]] = field(default_factory=dict)
    error: Exception | None = None
    asked: list[str] = field(default_factory=list)

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        h, w = scene.frame.depth.shape
        cropped = (h, w) != (H, W)
        self.asked.append(("crop: " if cropped else "") + (f"mark {plan.mark}" if plan.mark else plan.target))
        if self.error is not None:
            raise self.error
        if plan.mark is not None:
            p = scene.proposal(plan.mark)
            return Segmentation((segment_of(p.mask, plan.target, 1.0, p.mark),))
        segments = []
        for (x0, y0, x1, y1), score in (self.crop if cropped else self.whole).get(plan.target, []):
            mask = np.zeros((h, w), bool)
            mask[y0:y1, x0:x1] = True
            box, touches = (x0, y0, x1, y1), x0 == 0 or y0 == 0 or x1 == w or y1 == h
            segments.append(Segment(plan.target, score, mask, box, touches))
        return Segmentation(tuple(segments))


def cascade(objects: object = None, parts: object = None, **settings: object) -> CascadeSegmenter:
    plenty = {"min_side_px": 0, "min_sharpness": 0.0}
    return CascadeSegmenter(objects=objects or Scripted(), parts=parts, **{**plenty, **settings})  # type: ignore[arg-type]


def said(result: Segmentation) -> list[tuple[str, str]]:
    assert all(d.stage == "segment" for d in result.degraded)
    return [(d.reason, d.fallback) for d in result.degraded]


def shown(result: Segmentation) -> list[tuple[str, tuple[int, int, int, int]]]:
    return [(s.label, s.box_xyxy) for s in result.segments]


OTHERS = (PlannedObject("spoon", 30), PlannedObject("pan", 70), PlannedObject("red mug", 90))


@dataclass(frozen=True)
class Case:
    """One row for objects."""

    name: str
    known: dict[str, list[tuple[tuple[int, int, int, int], float]]]
    asked: list[str]
    shown: list[tuple[str, tuple[int, int, int, int]]]
    said: list[tuple[str, str]]
    error: Exception | None = None


NO_MUG = ("Scripted finds no 'red mug'", "'mug'")
EVERYTHING, NOTHING_AT_ALL = (0, 0, W, H), (50, 50, 50, 50)
OBJECTS = [
    Case(
        "a mask of everything is of no thing, whatever it scores",
        {"red mug": [(EVERYTHING, 0.95)], "mug": [(MUG, 0.3)]},
        ["red mug", "mug"],
        [("mug", MUG)],
        [("Scripted finds no 'red mug' but 1 covering more than 90% of the image", "'mug'")],
    ),
    Case(
        "an empty mask is nothing",
        {"red mug": [(NOTHING_AT_ALL, 0.9), (CUT, 0.4), (MUG, 0.3)]},
        ["red mug"],
        [("red mug", MUG)],
        [
            (
                "of what Scripted finds for 'red mug', 1 with an empty mask and 1 cut by the border, scoring less "
                "than 0.5",
                "left out",
            )
        ],
    ),
    Case(
        "of equal scores the first stays first",
        {"red mug": [(MUG_2, 0.5), (MUG, 0.5)]},
        ["red mug"],
        [("red mug", MUG_2), ("red mug", MUG)],
        [],
    ),
    Case("the name is found", {"red mug": [(MUG, 0.8)]}, ["red mug"], [("red mug", MUG)], []),
    Case(
        "all masks, best first",
        {"red mug": [(MUG, 0.6), (MUG_2, 0.9)]},
        ["red mug"],
        [("red mug", MUG_2), ("red mug", MUG)],
        [],
    ),
    Case("the head noun", {"mug": [(MUG, 0.8)]}, ["red mug", "mug"], [("mug", MUG)], [NO_MUG]),
    Case(
        "the best alternative",
        {"spoon": [(MUG, 0.5)], "pan": [(MUG_2, 0.5)]},
        ["red mug", "mug", "pan"],
        [("pan", MUG_2)],
        [NO_MUG, ("Scripted finds no 'mug'", "'pan'")],
    ),
    Case(
        "the next alternative",
        {"spoon": [(MUG, 0.5)]},
        ["red mug", "mug", "pan", "spoon"],
        [("spoon", MUG)],
        [NO_MUG, ("Scripted finds no 'mug'", "'pan'"), ("Scripted finds no 'pan'", "'spoon'")],
    ),
    Case(
        "it fails each time",
        {},
        ["red mug", "mug", "pan", "spoon"],
        [],
        [
            ("Scripted failed (RuntimeError: out of memory)", "'mug'"),
            ("Scripted failed (RuntimeError: out of memory)", "'pan'"),
            ("Scripted failed (RuntimeError: out of memory)", "'spoon'"),
            ("Scripted failed (RuntimeError: out of memory)", "the geometric proposals"),
            ("no object proposals (the scene stage is off or found nothing)", "no segment"),
        ],
        RuntimeError("out of memory\nTried to allocate"),
    ),
    Case(
        "what the border cuts scores too little",
        {"red mug": [(CUT, 0.4)], "mug": [(MUG, 0.3)]},
        ["red mug", "mug"],
        [("mug", MUG)],
        [("Scripted finds no 'red mug' but 1 cut by the border, scoring less than 0.5", "'mug'")],
    ),
    Case("what the border cuts scores enough", {"red mug": [(CUT, 0.5)]}, ["red mug"], [("red mug", CUT)], []),
    Case(
        "of several the border cuts one",
        {"red mug": [(CUT, 0.4), (MUG, 0.35)]},
        ["red mug"],
        [("red mug", MUG)],
        [
            (
                "of what Scripted finds for 'red mug', 1 cut by the border, scoring less than 0.5",
                "left out",
            )
        ],
    ),
]


@pytest.mark.parametrize("case", OBJECTS, ids=lambda c: c.name)
def test_objects(case: Case) -> None:
    objects = Scripted(whole=case.known, error=case.error)
    result = cascade(objects).segment(strict_scene(), Plan("red mug", "", objects=OTHERS))
    assert objects.asked == case.asked
    assert shown(result) == case.shown
    assert said(result) == case.said


def test_the_proposals_are_the_last_resort() -> None:
    scene = sample_scene()
    result = cascade().segment(scene, Plan("red box", ""))
    expected = GeometricSegmenter().segment(scene, Plan("red box", ""))
    assert [s.mark for s in result.segments] == [s.mark for s in expected.segments]
    assert result.segments
    assert said(result) == [
        ("Scripted finds no 'red box'", "'box'"),
        ("Scripted finds no 'box'", "the geometric proposals"),
    ]


def test_a_mark_is_asked_for_once_and_falls_back_to_its_proposal() -> None:
    scene, objects = sample_scene(), Scripted()
    plan = Plan("mug", "", mark=3, objects=OTHERS)
    result = cascade(objects).segment(scene, plan)
    assert objects.asked == ["mark 3"]
    assert ([s.mark for s in result.segments], said(result)) == ([3], [])
    result = cascade(Scripted(error=ValueError("no weights"))).segment(scene, plan)
    assert result.segments[0].mark == 3
    assert said(result)[0] == ("Scripted failed (ValueError: no weights)", "the geometric proposals")


def test_a_mark_that_does_not_exist_is_a_broken_contract() -> None:
    with pytest.raises(ContractError, match="no proposal has mark 99"):
        cascade().segment(sample_scene(), Plan("mug", "", mark=99))


GRID = "the object; the grid cell picks the part"
CROP = "its object, and the part in its crop"
PART = Plan("red mug handle", "", kind="part")
# In the crop of MUG, widened by 0.1 (8 and 10 px), the handle lies 32 px left and 50 px up of where it is.
IN_CROP = (110 - 32, 90 - 50, 120 - 32, 130 - 50)
BESIDE = (0, 0, 6, 6)


@dataclass(frozen=True)
class PartCase:
    """One row for parts."""

    name: str
    parts: Scripted | None
    asked_parts: list[str]
    asked_objects: list[str]
    shown: list[tuple[str, tuple[int, int, int, int]]]
    said: list[tuple[str, str]]
    settings: dict[str, object] = field(default_factory=dict)
    plan: Plan = PART


NOTHING = ("no object proposals", "no segment")
NO_HANDLE = "Scripted finds no 'red mug handle'"
PARTS = [
    PartCase(
        "the part is found",
        Scripted(whole={PART.target: [(HANDLE, 0.8)]}),
        [PART.target],
        [],
        [(PART.target, HANDLE)],
        [],
    ),
    PartCase(
        "the part is found in the crop",
        Scripted(crop={PART.target: [(IN_CROP, 0.8)]}),
        [PART.target, f"crop: {PART.target}"],
        ["red mug"],
        [(PART.target, (110, 90, 120, 130))],
        [(NO_HANDLE, CROP)],
    ),
    PartCase(
        "the part is found nowhere",
        Scripted(),
        [PART.target, f"crop: {PART.target}"],
        ["red mug"],
        [("red mug", MUG)],
        [(NO_HANDLE, CROP), (f"{NO_HANDLE} in the crop of 'red mug'", GRID)],
    ),
    PartCase(
        "the part is found beside its object",
        Scripted(crop={PART.target: [(BESIDE, 0.9)]}),
        [PART.target, f"crop: {PART.target}"],
        ["red mug"],
        [("red mug", MUG)],
        [(NO_HANDLE, CROP), (f"Scripted finds {PART.target!r} beside its object only", GRID)],
    ),
    PartCase(
        "the segmenter of parts fails",
        Scripted(error=RuntimeError("boom")),
        [PART.target, f"crop: {PART.target}"],
        ["red mug"],
        [("red mug", MUG)],
        [
            ("Scripted failed (RuntimeError: boom)", CROP),
            ("Scripted failed (RuntimeError: boom) in the crop of 'red mug'", GRID),
        ],
    ),
    PartCase(
        "no crop",
        Scripted(crop={PART.target: [(IN_CROP, 0.8)]}),
        [PART.target],
        ["red mug"],
        [("red mug", MUG)],
        [(NO_HANDLE, GRID)],
        {"crop_then_prompt": False},
    ),
    PartCase(
        "there is no segmenter of parts",
        None,
        [],
        ["red mug"],
        [("red mug", MUG)],
        [("there is no segmenter of parts", GRID)],
    ),
    PartCase(
        "the image is small",
        Scripted(whole={PART.target: [(HANDLE, 0.8)]}),
        [],
        ["red mug"],
        [("red mug", MUG)],
        [("the image's shorter side is 240 px, parts need 400", GRID)],
        {"min_side_px": 400},
    ),
    PartCase(
        "the image is blurred",
        Scripted(whole={PART.target: [(HANDLE, 0.8)]}),
        [],
        ["red mug"],
        [("red mug", MUG)],
        [("the image's sharpness is", GRID)],
        {"min_sharpness": 1e6},
    ),
    PartCase(
        "no part is named",
        Scripted(),
        [],
        ["red"],
        [],
        [("'red' names no part", GRID), ("Scripted finds no 'red'", "the geometric proposals"), NOTHING],
        plan=Plan("red", "", kind="part"),
    ),
    PartCase(
        "neither part nor object",
        Scripted(),
        ["pan lid"],
        ["pan"],
        [],
        [("Scripted finds no 'pan lid'", CROP), ("Scripted finds no 'pan'", "the geometric proposals"), NOTHING],
        plan=Plan("pan lid", "", kind="part"),
    ),
]


@pytest.mark.parametrize("case", PARTS, ids=lambda c: c.name)
def test_parts(case: PartCase) -> None:
    objects = Scripted(whole={"red mug": [(MUG_2, 0.5), (MUG, 0.8)][1:]})
    parts = case.parts and Scripted(case.parts.whole, case.parts.crop, case.parts.error)
    result = cascade(objects, parts, **case.settings).segment(strict_scene(), case.plan)
    assert (parts.asked if parts else []) == case.asked_parts
    assert objects.asked == case.asked_objects
    assert shown(result) == case.shown
    for (reason, fallback), expected in zip(said(result), case.said, strict=True):
        assert reason.startswith(expected[0])
        assert fallback == expected[1]


def test_a_part_of_a_mark_is_looked_for_in_its_crop_alone() -> None:
    scene = sample_scene()
    x0, y0, x1, y1 = scene.proposal(3).box_xyxy
    parts = Scripted(crop={"mug handle": [((2, 2, x1 - x0, y1 - y0), 0.9)]})
    plan = Plan("mug handle", "", kind="part", mark=3)
    result = cascade(Scripted(), parts, crop_margin=0.0).segment(scene, plan)
    assert parts.asked == ["crop: mug handle"]
    assert shown(result) == [("mug handle", (x0 + 2, y0 + 2, x1, y1))]
    nothing = cascade(Scripted(), Scripted()).segment(scene, plan)
    assert [s.mark for s in nothing.segments] == [3]
    assert said(nothing) == [("Scripted finds no 'mug handle' in the crop of 'mug'", GRID)]


def test_without_crops_a_part_of_a_mark_is_not_looked_for() -> None:
    parts = Scripted(crop={"mug handle": [((2, 2, 9, 9), 0.9)]})
    plan = Plan("mug handle", "", kind="part", mark=3)
    result = cascade(Scripted(), parts, crop_then_prompt=False).segment(sample_scene(), plan)
    assert parts.asked == []
    assert [s.mark for s in result.segments] == [3]
    assert said(result) == [("no part of a mark is looked for where crop_then_prompt is off", GRID)]


def test_so_many_alternatives_are_asked_for_and_no_more() -> None:
    for most, asked in ((0, []), (1, ["pan"]), (2, ["pan", "spoon"]), (9, ["pan", "spoon"])):
        objects = Scripted()
        cascade(objects, max_alternatives=most).segment(strict_scene(), Plan("red mug", "", objects=OTHERS))
        assert objects.asked == ["red mug", "mug", *asked]


def test_a_part_that_is_everything_is_looked_for_in_the_crop() -> None:
    objects = Scripted(whole={"red mug": [(MUG, 0.8)]})
    parts = Scripted(whole={PART.target: [(EVERYTHING, 0.9)]}, crop={PART.target: [(IN_CROP, 0.8)]})
    result = cascade(objects, parts).segment(strict_scene(), PART)
    assert shown(result) == [(PART.target, (110, 90, 120, 130))]
    assert said(result) == [(f"{NO_HANDLE} but 1 covering more than 90% of the image", CROP)]


def test_what_a_segmenter_says_of_itself_is_passed_on() -> None:
    class Talkative(Scripted):
        def segment(self, scene: Scene, plan: Plan) -> Segmentation:
            found = super().segment(scene, plan)
            return Segmentation(found.segments, (Degradation("segment", "coarse", "as it is"),))

    result = cascade(Talkative(whole={"mug": [(MUG, 0.9)]})).segment(strict_scene(), Plan("mug", ""))
    assert said(result) == [("coarse", "as it is")]


def test_inputs_are_left_alone_and_the_same_question_has_the_same_answer() -> None:
    stage = cascade(Scripted(whole={"red mug": [(MUG, 0.8)]}), Scripted(crop={PART.target: [(IN_CROP, 0.8)]}))
    before = strict_scene().frame.color.copy()
    first, second = (stage.segment(strict_scene(), PART) for _ in range(2))
    np.testing.assert_array_equal(first.segments[0].mask, second.segments[0].mask)
    np.testing.assert_array_equal(strict_scene().frame.color, before)


class TestMaking:
    def test_by_name_and_by_name_with_settings(self) -> None:
        stage = CascadeSegmenter(
            objects="geometric", parts={"name": "geometric", "settings": {"max_segments": 2}}, proposals="geometric"
        )
        assert isinstance(stage, Segmenter)
        assert stage.parts is not None
        assert stage.parts.segmenter.max_segments == 2  # type: ignore[attr-defined]

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"objects": "geometrc"}, "cascade segmenter: objects: no segmenter named 'geometrc'.*Did you mean"),
            ({"parts": "no_such"}, "parts: no segmenter named 'no_such'.*or set parts=null to do without"),
            (
                {"objects": {"name": "geometric", "settings": {"min_score": 7}}},
                "objects: geometric segmenter: min_score",
            ),
            ({"objects": {"name": "geometric", "settings": {"speed": 7}}}, r"does not take the settings \['speed'\]"),
            ({"objects": {"nam": "geometric"}}, "objects must be a plug-in name"),
            ({"objects": 7}, "objects must be a plug-in name.*got 7"),
            ({"objects": None}, "objects must be a plug-in name"),
            ({"min_side_px": -1}, "min_side_px must be at least 0"),
            ({"min_sharpness": float("nan")}, "min_sharpness must be at least 0"),
            ({"crop_margin": -0.1}, "crop_margin"),
            ({"max_alternatives": -1}, "max_alternatives"),
            ({"border_score": 1.5}, r"border_score must lie in \[0, 1\]"),
            ({"max_share": 0.0}, r"max_share must lie in \(0, 1\]"),
        ],
    )
    def test_settings_are_checked(self, settings: dict[str, object], message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            CascadeSegmenter(**{"objects": "geometric", "parts": None, **settings})  # type: ignore[arg-type]

    def test_a_configuration_file_can_hold_it(self) -> None:
        from thinkgrasp.config import from_json, load_config, override, to_json

        config = override(load_config("offline"), "segmenter", "cascade")
        for key, value in (("parts", None), ("objects", {"name": "geometric", "settings": {"max_segments": 1}})):
            config = override(config, f"segmenter.{key}", value)
        assert from_json(to_json(config)) == config
        from thinkgrasp import make_pipeline

        assert isinstance(make_pipeline(config).segmenter, CascadeSegmenter)
