"""Boxes to masks, with a model and without."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from thinkgrasp.errors import ContractError
from thinkgrasp.segmenters.box_masks import fill_holes, model_masks, scene_mask
from thinkgrasp.testing import sample_scene, strict_scene

SCENE = sample_scene()


class Painter:
    """Answers with what it is told."""

    def __init__(self, answer) -> None:
        self.answer = answer

    def masks(self, image, boxes):
        return SimpleNamespace(masks=self.answer(image, boxes))


def box_of(proposal) -> np.ndarray:
    return np.array(proposal.box_xyxy, np.float32)


def test_a_box_takes_the_proposal_in_it():
    for proposal in SCENE.proposals:
        found = scene_mask(SCENE, box_of(proposal), proposal)
        assert found.mark == proposal.mark
        np.testing.assert_array_equal(found.mask, proposal.mask)
        x0, y0, x1, y1 = box_of(proposal)
        half = scene_mask(SCENE, np.array([x0, y0, (x0 + x1) / 2, y1], np.float32), proposal)
        assert half.mask.sum() < proposal.mask.sum()
        assert not (half.mask & ~proposal.mask).any()
        assert "proposal" in (half.fallback or "")


def test_without_proposals_the_region_above_the_support():
    bare = replace(SCENE, proposals=())
    found = scene_mask(bare, box_of(SCENE.proposals[0]))
    assert found.mark is None
    assert not (found.mask & ~bare.region).any()
    assert "depth" in (found.fallback or "")


def test_in_strict_mode_what_is_as_near_as_the_middle():
    scene = strict_scene()
    target = SCENE.proposals[0]
    found = scene_mask(scene, box_of(target))
    shared = (found.mask & target.mask).sum() / target.mask.sum()
    assert shared > 0.5
    assert "depth" in (found.fallback or "")


def test_without_depth_the_whole_box_at_least_a_pixel():
    frame = replace(SCENE.frame, depth=np.zeros_like(SCENE.frame.depth))
    blind = replace(SCENE, frame=frame, proposals=(), region=None)
    found = scene_mask(blind, np.array([3.2, 4.9, 8.1, 6.0], np.float32))
    assert found.fallback == "the whole box"
    assert found.mask.sum() == found.mask[4:6, 3:9].sum() == 12
    height, width = frame.depth.shape
    corner = scene_mask(blind, np.array([width - 0.2, height - 0.1, width, height], np.float32))
    assert corner.mask.sum() == 1
    assert scene_mask(blind, np.array([0, 0, 0.1, 0.1], np.float32)).mask.sum() == 1


def test_a_models_masks_are_filled_and_belong_to_the_proposal_below():
    target = SCENE.proposals[0]
    holed = target.mask.copy()
    v, u = np.argwhere(target.mask).mean(axis=0).astype(int)
    holed[v, u] = False
    boxes = box_of(target)[None]
    (found,) = model_masks(Painter(lambda c, b: holed[None]), SCENE, boxes, 400)
    assert found.mask[v, u]
    assert (found.mark, found.fallback) == (target.mark, None)
    nothing = np.zeros_like(holed)
    (empty,) = model_masks(Painter(lambda c, b: nothing[None]), SCENE, boxes, 400)
    assert empty.mark is None


@pytest.mark.parametrize("answer", [None, np.zeros((1, 2, 2), np.bool_), np.zeros((1, 240, 320), np.float32)])
def test_a_model_that_breaks_its_contract(answer):
    with pytest.raises(ContractError, match=r"Painter\.masks must return masks"):
        model_masks(Painter(lambda c, b: answer), SCENE, np.zeros((1, 4), np.float32), 400)


def test_holes_are_filled_by_size_and_islands_stay():
    mask = np.zeros((40, 40), np.bool_)
    mask[2:30, 2:30] = True
    mask[5:7, 5:8] = mask[15:25, 15:25] = False
    mask[35, 35] = True
    filled = fill_holes(mask, 7)
    assert filled[5:7, 5:8].all()
    assert not filled[15:25, 15:25].any()
    assert filled[35, 35]
    np.testing.assert_array_equal(fill_holes(mask, 6), mask)
    assert fill_holes(np.ones((3, 3), np.bool_), 5).all()


def test_holes_that_touch_at_a_corner_are_one():
    mask = np.ones((30, 30), np.bool_)
    mask[5, 5] = mask[6, 6] = False
    np.testing.assert_array_equal(fill_holes(mask, 2), mask)
    assert fill_holes(mask, 3).all()
