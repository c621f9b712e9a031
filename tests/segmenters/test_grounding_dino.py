"""Boxes from text, on a small network with random weights: the library's numbers, sorted by phrase."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.gpu import needs_gpu
from fakes.models import SIZES_WH, model, picture

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from thinkgrasp.segmenters.boxes import box_iou  # noqa: E402
from thinkgrasp.segmenters.grounding_dino import Detections, GroundingDino  # noqa: E402

PHRASES = ("red mug", "a box", "x")


def detector(**settings) -> GroundingDino:
    return GroundingDino(model("grounding_dino"), device="cpu", **settings)


@pytest.fixture(scope="module")
def everything() -> GroundingDino:
    """Keeps what a threshold or an overlap would remove."""
    return detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0)


def equal(a: Detections, b: Detections, tolerance: float = 0.0) -> bool:
    if len(a.boxes) != len(b.boxes):
        return False
    return bool(
        np.allclose(a.boxes, b.boxes, rtol=0, atol=tolerance * 640)
        and np.allclose(a.scores, b.scores, rtol=0, atol=tolerance)
    )


def count_calls(module: torch.nn.Module) -> list[int]:
    calls: list[int] = []
    module.register_forward_hook(lambda *_: calls.append(1))
    return calls


@pytest.mark.parametrize("wh", SIZES_WH)
def test_boxes_lie_in_the_image_and_come_best_first(wh, everything):
    for found in everything.detect(picture(*wh), PHRASES):
        assert found.boxes.dtype == found.scores.dtype == np.float32
        assert found.boxes.shape == (len(found.scores), 4)
        assert len(found.boxes) > 5
        assert (found.boxes >= 0).all()
        assert (found.boxes <= [*wh, *wh]).all()
        assert (found.boxes[:, 2:] - found.boxes[:, :2] >= 1).all()
        assert ((found.scores > 0) & (found.scores <= 1)).all()
        assert list(found.scores) == sorted(found.scores, reverse=True)


@pytest.mark.parametrize("wh", SIZES_WH)
def test_boxes_and_scores_are_the_librarys(wh, everything):
    """The library's own processor and its model as it comes, backbone and all, on the same phrase."""
    from transformers import AutoTokenizer, GroundingDinoForObjectDetection
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil
    from transformers.models.grounding_dino.processing_grounding_dino import GroundingDinoProcessor

    folder, image = model("grounding_dino"), picture(*wh)
    images = GroundingDinoImageProcessorPil.from_pretrained(folder)
    processor = GroundingDinoProcessor(images, AutoTokenizer.from_pretrained(folder))
    network = GroundingDinoForObjectDetection.from_pretrained(folder).eval()
    inputs = processor(images=image, text=[["red mug"]], return_tensors="pt")
    with torch.no_grad():
        outputs = network(**inputs)
    (theirs,) = processor.post_process_grounded_object_detection(
        outputs, threshold=0.5, text_threshold=0.0, target_sizes=[image.shape[:2]]
    )
    ours = detector(box_threshold=0.5, text_threshold=0.0, max_iou=1.0).detect(image, ["red mug"])[0]
    order = np.argsort(-theirs["scores"].numpy(), kind="stable")
    expected = np.clip(theirs["boxes"].numpy()[order], 0, np.tile(image.shape[1::-1], 2))
    shown = (expected[:, 2:] - expected[:, :2] >= 1).all(axis=1)
    assert shown.sum() > 3
    np.testing.assert_allclose(ours.scores, theirs["scores"].numpy()[order][shown], rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.boxes, expected[shown], rtol=0, atol=1e-3)


def test_the_same_image_gives_the_same_boxes(everything):
    first, second = (everything.detect(picture(640, 480), PHRASES) for _ in range(2))
    assert all(equal(a, b) for a, b in zip(first, second, strict=True))
    again = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0).detect(picture(640, 480), PHRASES)
    assert all(equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_batch_of_phrases_is_each_phrase_alone(everything):
    image = picture(640, 480)
    together = everything.detect(image, ["red mug", "a much longer phrase", "x"])
    for phrase, found in zip(["red mug", "a much longer phrase", "x"], together, strict=True):
        assert equal(found, everything.detect(image, [phrase])[0], 1e-4), phrase
    small = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0, batch=1)
    assert all(
        equal(a, b, 1e-4) for a, b in zip(small.detect(image, PHRASES), everything.detect(image, PHRASES), strict=True)
    )


def test_another_phrase_does_not_run_the_backbone():
    dino = detector()
    calls = count_calls(dino.backbone)
    first, second = picture(224, 224), picture(224, 224, seed=1)
    dino.detect(first, ["red mug"])
    dino.detect(first.copy(), ["a box", "x"])
    assert len(calls) == 1
    dino.detect(second, ["red mug"])
    dino.detect(first, ["red mug"])
    assert len(calls) == 2
    without = detector(cached_images=0)
    calls = count_calls(without.backbone)
    for phrase in PHRASES:
        without.detect(first, [phrase])
    assert len(calls) == 3


@needs_gpu
@pytest.mark.parametrize("wh", SIZES_WH)
def test_a_gpu_gives_the_same(wh, everything):
    settings = {"box_threshold": 0.0, "text_threshold": 0.0, "max_iou": 1.0}
    on_gpu = GroundingDino(model("grounding_dino"), device="cuda", **settings)
    for ours, found in zip(everything.detect(picture(*wh), PHRASES), on_gpu.detect(picture(*wh), PHRASES), strict=True):
        assert equal(ours, found, 1e-4)
    for dtype in ("bfloat16", "float16"):
        half = GroundingDino(model("grounding_dino"), device="cuda", dtype=dtype, **settings)
        assert all(np.isfinite(found.scores).all() and len(found.boxes) for found in half.detect(picture(*wh), PHRASES))


def test_what_was_cached_changes_nothing():
    dino = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0)
    image = picture(640, 480)
    dino.detect(image, ["x", "a box"])
    fresh = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0, cached_images=0)
    assert equal(dino.detect(image, ["red mug"])[0], fresh.detect(image, ["red mug"])[0])


def test_phrases_in_one_caption_share_the_boxes_out():
    image = picture(640, 480)
    dino = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0, together=True)
    calls = count_calls(dino._model.model.encoder)
    found = dino.detect(image, PHRASES)
    assert len(calls) == 1
    assert len(found) == 3
    rows = [tuple(box) for one in found for box in one.boxes.round(3)]
    assert len(rows) == len(set(rows)), "a box answers to one phrase"
    assert 0 < len(rows) <= 30


def test_thresholds_and_overlap_remove_what_they_say(everything):
    image = picture(640, 480)
    (all_of_it,) = everything.detect(image, ["red mug"])
    limit = float(np.median(all_of_it.scores))
    (strict,) = detector(box_threshold=limit, text_threshold=0.0, max_iou=1.0).detect(image, ["red mug"])
    np.testing.assert_array_equal(strict.scores, all_of_it.scores[all_of_it.scores > limit])
    assert len(detector(text_threshold=1.0).detect(image, ["red mug"])[0].boxes) == 0
    (apart,) = detector(box_threshold=0.0, text_threshold=0.0, max_iou=0.1).detect(image, ["red mug"])
    overlaps = box_iou(apart.boxes, apart.boxes) - np.eye(len(apart.boxes))
    assert overlaps.max() <= 0.1
    assert len(apart.boxes) < len(all_of_it.boxes)


def test_a_phrase_longer_than_the_network_reads_is_cut(everything):
    (found,) = everything.detect(picture(224, 224), ["mug " * 300])
    assert np.isfinite(found.boxes).all()
    limit = everything.text_limit
    words = [f"mug{i % 7}" for i in range(limit)]
    (read,) = (len(everything._offsets(" ".join(words))),)
    assert read == limit
    assert everything.unread("A red mug.") == ""
    rest = everything.unread(" ".join(words))
    assert rest.endswith("...")
    assert rest[:-3] in " ".join(words)


def test_phrases_that_do_not_fit_into_one_caption_are_asked_in_several():
    """Not cut: the last would find nothing, and nothing would say why."""
    image = picture(224, 224)
    dino = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0, together=True)
    per_word = len(dino._offsets("mug mug")) - len(dino._offsets("mug"))
    phrases = [f"{word} " * (dino.text_limit * 6 // 10 // per_word) for word in ("mug", "gum", "mug")]
    calls = count_calls(dino._model.model.encoder)
    found = dino.detect(image, phrases)
    assert [len(one.boxes) > 0 for one in found] == [True] * 3
    assert len(calls) < 3, "captions run in batches"
    assert all(dino.unread(phrase) == "" for phrase in phrases)
    assert dino.detect(image, []) == ()


def test_half_precision(everything):
    dino = detector(box_threshold=0.0, text_threshold=0.0, max_iou=1.0, dtype="bfloat16")
    (found,) = dino.detect(picture(224, 224), ["red mug"])
    assert found.boxes.dtype == np.float32
    assert len(found.boxes) > 5
    assert np.isfinite(found.boxes).all()
