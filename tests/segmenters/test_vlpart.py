"""The vlpart segmenter: plans to masks, and clear words where there are none."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import TINY, save_checkpoint

from thinkgrasp.errors import ConfigError, ContractError, InputError, MissingDependency
from thinkgrasp.interfaces import Segmenter
from thinkgrasp.networks.part_finder import PartBoxes
from thinkgrasp.segmenters.vlpart import VLPartSegmenter, part_name
from thinkgrasp.testing import check_segmenter, empty_scene, sample_scene, strict_scene
from thinkgrasp.types import Plan

SCENE = sample_scene()
HEIGHT, WIDTH = SCENE.frame.depth.shape


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return save_checkpoint(tmp_path_factory.mktemp("vlpart"))


def make(files, **settings) -> VLPartSegmenter:
    weights, tokenizer = files
    given = {"weights": weights, "tokenizer": tokenizer, "cache_folder": None, "config": TINY, "device": "cpu"}
    return VLPartSegmenter(**given | settings)


class Found:
    """A finder that has found these boxes."""

    def __init__(self, *boxes: tuple[float, tuple[float, ...]], notes: tuple[str, ...] = ()) -> None:
        self.boxes, self.said, self.asked = boxes, notes, []

    def find(self, color, names):
        self.asked.append(list(names))
        if "unknown" in names:
            raise InputError("'a unknown' is not among the names")
        boxes = self.boxes if names else ()
        scores = np.array([s for s, _ in boxes], np.float32)
        return PartBoxes(tuple(names) * len(boxes), np.array([b for _, b in boxes], np.float32).reshape(-1, 4), scores)

    def notes(self):
        return self.said


def finding(files, *boxes, notes=(), **settings) -> VLPartSegmenter:
    segmenter = make(files, **settings)
    segmenter.finder = Found(*boxes, notes=notes)  # type: ignore[assignment]
    return segmenter


@pytest.mark.parametrize("threshold", [0.0, 0.5])
@pytest.mark.parametrize("variant", ["paper", "upstream"])
def test_it_keeps_its_contract_with_a_real_network(files, threshold, variant):
    segmenter = make(files, threshold=threshold, variant=variant)
    assert isinstance(segmenter, Segmenter)
    check_segmenter(segmenter)
    found = segmenter.segment(SCENE, Plan("mug: handle", "", kind="part"))
    assert bool(found.segments) == (threshold == 0) or found.degraded


def test_masks_come_from_proposals_and_that_is_said(files):
    first, second = SCENE.proposals[:2]
    segmenter = finding(files, (0.9, second.box_xyxy), (0.6, first.box_xyxy), (0.2, first.box_xyxy))
    found = segmenter.segment(SCENE, Plan("mug: handle", "", kind="part"))
    assert [s.score for s in found.segments] == pytest.approx([0.9, 0.6])
    assert [s.mark for s in found.segments] == [second.mark, first.mark]
    assert {s.label for s in found.segments} == {"mug: handle"}
    assert segmenter.finder.asked == [["mug:handle"]]  # type: ignore[attr-defined]
    (said,) = found.degraded
    assert (said.stage, said.reason) == ("segment", "no model that turns boxes into masks (SAM) is set")


def test_a_planned_mark_limits_where_the_part_is(files):
    first, second = SCENE.proposals[:2]
    segmenter = finding(files, (0.9, second.box_xyxy), (0.6, first.box_xyxy))
    found = segmenter.segment(SCENE, Plan("mug: handle", "", kind="part", mark=first.mark))
    assert [s.mark for s in found.segments] == [first.mark]
    nothing = finding(files, (0.9, second.box_xyxy)).segment(SCENE, Plan("mug", "", mark=first.mark))
    assert nothing.segments == ()
    assert f"no box on mark {first.mark}" in nothing.degraded[0].reason
    with pytest.raises(ContractError, match="no proposal has mark 99"):
        segmenter.segment(SCENE, Plan("mug", "", mark=99))


def test_an_obstruction_is_returned_alone_and_never_too_many(files):
    boxes = [(0.9 - i / 100, p.box_xyxy) for i, p in enumerate(SCENE.proposals)]
    assert len(finding(files, *boxes).segment(SCENE, Plan("box", "", role="obstruction")).segments) == 1
    assert len(finding(files, *boxes, max_segments=2).segment(SCENE, Plan("box", "")).segments) == 2


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("mug", "the best of VLPart's boxes scores 0.29, below 0.3"),
        ("unknown", "is not among the names"),
        (" . ", None),
        (":", "VLPart has no box"),
    ],
)
def test_nothing_found_is_a_value_and_says_why(files, target, reason):
    found = finding(files, (0.29, (0, 0, 9, 9))).segment(SCENE, Plan(target, ""))
    assert found.segments == ()
    assert reason is None or reason in found.degraded[0].reason


def test_the_threshold_is_reached_not_passed(files):
    box = SCENE.proposals[0].box_xyxy
    assert finding(files, (0.5, box), threshold=0.5).segment(SCENE, Plan("mug", "")).segments


def test_notes_of_the_text_are_passed_on(files):
    found = finding(files, (0.9, (5, 5, 50, 50)), notes=("file x is damaged",)).segment(SCENE, Plan("mug", ""))
    assert found.degraded[0].reason == "file x is damaged"


class Sam:
    """Fills each box, but for those wider than 100 px."""

    def masks(self, image, boxes):
        masks = np.zeros((len(boxes), *image.shape[:2]), np.bool_)
        for mask, (x0, y0, x1, y1) in zip(masks, boxes.astype(int), strict=True):
            if x1 - x0 <= 100:
                mask[y0:y1, x0:x1] = True
        return SimpleNamespace(masks=masks)


def test_a_model_makes_the_masks_and_nothing_is_degraded(files):
    found = finding(files, (0.9, (10, 20, 60, 50)), masker=Sam()).segment(SCENE, Plan("mug", ""))
    (segment,) = found.segments
    assert segment.box_xyxy == (10, 20, 60, 50)
    assert segment.mask.sum() == 50 * 30
    assert not segment.touches_border
    assert found.degraded == ()


def test_an_empty_mask_is_left_out_and_said(files):
    boxes = (0.9, (0, 0, 200, 50)), (0.8, (0, 20, 60, 50))
    found = finding(files, *boxes, masker=Sam()).segment(SCENE, Plan("mug", ""))
    assert [s.score for s in found.segments] == pytest.approx([0.8])
    assert found.segments[0].touches_border
    assert "1 of 2 boxes got an empty mask" in found.degraded[0].reason


@pytest.mark.parametrize("scene", [empty_scene(), strict_scene()])
def test_without_proposals_the_depth_helps(files, scene):
    found = finding(files, (0.9, (60, 60, 120, 110))).segment(scene, Plan("mug", ""))
    assert [s.mark for s in found.segments] == [None]
    assert found.degraded


@pytest.mark.parametrize(
    ("target", "name"),
    [
        ("mug: handle", "mug:handle"),
        ("mug:handle", "mug:handle"),
        ("  the  Mug :  handle ", "Mug:handle"),
        ("handle of the mug", "mug:handle"),
        ("the cap of a bottle", "bottle:cap"),
        ("blue mug handle", "blue mug handle"),
        ("mug:", "mug"),
        ("", ""),
    ],
)
def test_a_target_is_written_as_the_vocabularies_do(target, name):
    assert part_name(target) == name


def test_a_whole_objects_of_stays():
    assert part_name("a bottle of water", "object") == "bottle of water"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weights": None}, r"swinbase_part_0a0000\.pth is not on this machine .*CC-BY-NC.*curl .*https"),
        ({"weights": "vlpart-upstream"}, r"is not on this machine \(licence: MIT.*PeizeSun/VLPart"),
        ({"weights": "nowhere.pth"}, "weights file nowhere.pth does not exist"),
        ({"threshold": 1}, "threshold"),
        ({"threshold": -0.1}, "threshold"),
        ({"threshold": float("nan")}, "threshold"),
        ({"threshold": True}, "threshold"),
        ({"max_segments": 0}, "max_segments"),
        ({"max_segments": 2.5}, "max_segments"),
        ({"variant": "mine"}, "variant"),
        ({"dtype": "float64"}, "dtype"),
        ({"device": "toaster"}, "device"),
        ({"masker": object()}, "masker must have a method masks"),
        ({"text_weights": "nowhere.pt"}, r"nowhere\.pt"),
        ({"text_table": "nowhere.npz"}, r"nowhere\.npz"),
        ({"text_table": "a", "text_weights": "b"}, "not both"),
    ],
)
def test_bad_settings_are_one_clear_error(files, settings, message):
    with pytest.raises(ConfigError, match=message):
        make(files, **settings)


def test_without_torch_the_install_line_is_said(files, monkeypatch):
    monkeypatch.delitem(sys.modules, "thinkgrasp.networks.part_finder")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependency, match=r"the vlpart segmenter needs .*'torch'.*thinkgrasp\[langsam\]"):
        make(files)


def test_without_transformers_the_install_line_is_said(files, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingDependency, match=r"'transformers'.*thinkgrasp\[langsam\]"):
        make(files)


@pytest.mark.parametrize("content", [b"", b"<html>not found</html>", b"PK\x03\x04 broken"])
def test_a_bad_file_is_named_at_load(files, tmp_path, content):
    (tmp_path / "w.pth").write_bytes(content)
    with pytest.raises(ConfigError, match=r"VLPart: .*w\.pth"):
        make(files, weights=tmp_path / "w.pth")
