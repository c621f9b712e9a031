"""The segmenter of LangSAM's pair: plans in, segments out."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.models import model, picture

pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from thinkgrasp.errors import ConfigError, ContractError
from thinkgrasp.segmenters.grounded_sam import GroundedSamSegmenter
from thinkgrasp.segmenters.grounding_dino import Detections
from thinkgrasp.segmenters.segment_anything import BoxMasks
from thinkgrasp.testing import sample_scene, strict_scene
from thinkgrasp.types import Plan


class ScriptedDetector:
    """Finds boxes by phrase, and remembers what it was asked."""

    def __init__(self, **boxes: list[tuple[float, ...]]) -> None:
        self.boxes = boxes
        self.asked: list[list[str]] = []
        self.text_limit = 4

    def unread(self, phrase):
        return " ".join(phrase.split()[self.text_limit :])

    def detect(self, image, phrases):
        self.asked.append(list(phrases))
        return tuple(
            Detections(
                np.array([row[:4] for row in self.boxes.get(p, [])], np.float32).reshape(-1, 4),
                np.array([row[4] for row in self.boxes.get(p, [])], np.float32),
            )
            for p in phrases
        )


class Filled:
    """Masks that fill their boxes; whole pixels."""

    def masks(self, image, boxes):
        masks = np.zeros((len(boxes), *image.shape[:2]), bool)
        for mask, (x0, y0, x1, y1) in zip(masks, boxes.astype(int), strict=True):
            mask[y0:y1, x0:x1] = True
        return BoxMasks(masks, np.ones(len(boxes), np.float32))


MUGS = [(10, 20, 60, 90, 0.9), (100, 20, 160, 90, 0.6), (0, 0, 30, 30, 0.4)]


def scripted(**settings) -> GroundedSamSegmenter:
    detector = ScriptedDetector(mug=MUGS, box=[(5, 5, 5, 5, 0.5)])
    return GroundedSamSegmenter(detector=detector, masks=Filled(), **settings)  # type: ignore[arg-type]


def test_text_becomes_masks_with_the_detections_scores():
    found = scripted().segment(strict_scene(), Plan("mug", ""))
    assert [s.box_xyxy for s in found.segments] == [row[:4] for row in MUGS]
    assert [round(s.score, 3) for s in found.segments] == [0.9, 0.6, 0.4]
    assert [s.touches_border for s in found.segments] == [False, False, True]
    assert {s.label for s in found.segments} == {"mug"}
    assert found.degraded == ()


@pytest.mark.parametrize(("target", "most"), [("mug", 3), ("a big red mug with a handle", 0)])
def test_a_text_beyond_the_limit_is_said_to_be_cut(target, most):
    found = scripted().segment(strict_scene(), Plan(target, ""))
    assert len(found.segments) == most
    said = [(d.reason, d.fallback) for d in found.degraded]
    cut = ("the text is longer than the 4 tokens that are read; not read: 'with a handle'", "the text before that")
    assert said == ([] if most else [cut, (f"no box answers to {target!r}", "no segment")])
    marked = scripted().segment(sample_scene(), Plan("a big red mug with a handle", "", mark=1))
    assert marked.degraded == (), "a mark needs no text"


def test_at_most_so_many():
    assert len(scripted(max_segments=2).segment(strict_scene(), Plan("mug", "")).segments) == 2


@pytest.mark.parametrize("target", ["cup", "box", "?", "  "])
def test_nothing_found_is_a_value_that_says_so(target):
    found = scripted().segment(strict_scene(), Plan(target, ""))
    assert found.segments == ()
    assert [d.stage for d in found.degraded] == ["segment"] or target == "box"


def test_phrases_keep_their_place_and_blank_ones_are_not_asked():
    segmenter = scripted()
    found = segmenter.find(picture(320, 240), ["", "mug", "cup", "."])
    assert [len(one) for one in found] == [0, 3, 0, 0]
    assert segmenter.detector.asked == [["mug", "cup"]]  # type: ignore[union-attr]


class TestMarks:
    def test_a_mark_needs_no_text(self):
        segmenter, scene = scripted(), sample_scene()
        found = segmenter.segment(scene, Plan("mug", "", mark=3))
        assert [(s.mark, s.score) for s in found.segments] == [(3, 1.0)]
        assert found.segments[0].mask is scene.proposal(3).mask
        assert segmenter.detector.asked == []  # type: ignore[union-attr]

    def test_a_mark_can_be_refined_by_its_box(self):
        scene = sample_scene()
        marks = [p.mark for p in scene.proposals if p.mask.sum() > 0.55 * _area(p.box_xyxy)]
        found = scripted(refine_marks=True).segment(scene, Plan("mug", "", mark=marks[0]))
        box = scene.proposal(marks[0]).box_xyxy
        assert found.segments[0].mask.sum() == _area(box)
        assert found.segments[0].box_xyxy == box
        assert found.segments[0].mark == marks[0]
        assert found.degraded == ()

    def test_a_mask_of_something_else_is_not_taken(self):
        class Elsewhere(Filled):
            def masks(self, image, boxes):
                return super().masks(image, np.array([[0, 0, 5, 5]] * len(boxes)))

        scene = sample_scene()
        segmenter = GroundedSamSegmenter(detector=ScriptedDetector(), masks=Elsewhere(), refine_marks=True)  # type: ignore[arg-type]
        found = segmenter.segment(scene, Plan("mug", "", mark=1))
        assert found.segments[0].mask is scene.proposal(1).mask
        assert found.degraded[0].fallback == "the proposal's own mask"
        assert "0.00" in found.degraded[0].reason

    def test_a_part_of_a_mark_is_the_object_and_says_so(self):
        found = scripted().segment(sample_scene(), Plan("mug handle", "", kind="part", mark=1))
        assert found.segments[0].mark == 1
        assert "grid cell" in found.degraded[0].fallback

    def test_a_mark_that_does_not_exist_is_a_broken_contract(self):
        with pytest.raises(ContractError, match="no proposal has mark 99"):
            scripted().segment(sample_scene(), Plan("mug", "", mark=99))


def _area(box: tuple[int, int, int, int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


@pytest.mark.parametrize("masks", ["sam", "sam2", "sam3"])
def test_every_kind_of_masks_works_with_small_networks(masks):
    from thinkgrasp.segmenters.sam3_network import Sam3

    segmenter = GroundedSamSegmenter(
        detector=model("grounding_dino"),
        masks=Sam3(model("sam3"), device="cpu") if masks == "sam3" else model(masks),
        device="cpu",
        max_segments=3,
    )
    found = segmenter.segment(strict_scene(), Plan("red mug", ""))
    assert 0 < len(found.segments) <= 3
    assert all(s.mask.shape == (240, 320) for s in found.segments)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"box_threshold": -0.1}, "box_threshold"),
        ({"text_threshold": 2}, "text_threshold"),
        ({"max_iou": 1.5}, "max_iou"),
        ({"max_segments": 0}, "max_segments"),
        ({"dtype": "float8"}, "dtype must be one of float32, bfloat16, float16, got 'float8'"),
        ({"device": "abacus"}, "device 'abacus' cannot be used here"),
        ({"detector": "grounding-dino-gigantic"}, "no model of that name; known: grounding-dino-tiny"),
        ({"detector": "vgn"}, "vgn is a single file and no model folder"),
    ],
)
def test_settings_are_checked(settings, message):
    settings = {"detector": model("grounding_dino"), "masks": model("sam"), **settings}
    with pytest.raises(ConfigError, match=message):
        GroundedSamSegmenter(**settings)


def test_models_in_the_wrong_place_are_named():
    with pytest.raises(ConfigError, match="holds a 'sam' model; allowed: grounding-dino"):
        GroundedSamSegmenter(detector=model("sam"), masks=model("sam"), device="cpu")
    with pytest.raises(ConfigError, match="holds a 'grounding-dino' model; allowed: sam, sam2, sam2_video"):
        GroundedSamSegmenter(detector=model("grounding_dino"), masks=model("grounding_dino"), device="cpu")
