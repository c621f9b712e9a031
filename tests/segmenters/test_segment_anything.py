"""Masks from boxes, on small networks with random weights: the library's masks."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from fakes.gpu import needs_gpu
from fakes.models import SIZES_WH, model, picture

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from thinkgrasp.segmenters.segment_anything import SegmentAnything  # noqa: E402

KINDS = ("sam", "sam2")


def boxes(wh: tuple[int, int], n: int = 3) -> np.ndarray:
    corners = np.random.default_rng(3).uniform(0, 1, (n, 2, 2))
    return np.concatenate([corners.min(axis=1) * wh, corners.max(axis=1) * wh], axis=1).astype(np.float32)


@pytest.mark.parametrize("wh", SIZES_WH)
@pytest.mark.parametrize("kind", KINDS)
def test_one_mask_per_box_the_same_each_time(kind, wh):
    sam = SegmentAnything(model(kind), device="cpu")
    found = sam.masks(picture(*wh), boxes(wh, 11))
    assert found.masks.shape == (11, wh[1], wh[0])
    assert found.masks.dtype == np.bool_
    assert found.scores.shape == (11,)
    assert found.scores.dtype == np.float32
    assert 0 < found.masks.mean() < 1
    again = SegmentAnything(model(kind), device="cpu").masks(picture(*wh), boxes(wh, 11))
    np.testing.assert_array_equal(found.masks, again.masks)
    np.testing.assert_array_equal(found.scores, again.scores)


@pytest.mark.parametrize("wh", SIZES_WH)
def test_sams_masks_are_the_librarys(wh):
    from transformers import SamModel
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil
    from transformers.models.sam.processing_sam import SamProcessor

    image = picture(*wh)
    processor = SamProcessor(SamImageProcessorPil.from_pretrained(model("sam")))
    network = SamModel.from_pretrained(model("sam")).eval()
    inputs = processor(images=image, input_boxes=[boxes(wh).tolist()], return_tensors="pt")
    with torch.no_grad():
        out = network(
            pixel_values=inputs["pixel_values"], input_boxes=inputs["input_boxes"].float(), multimask_output=False
        )
    (theirs,) = processor.post_process_masks(out.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"])
    ours = SegmentAnything(model("sam"), device="cpu").masks(image, boxes(wh))
    np.testing.assert_array_equal(ours.masks, theirs[:, 0].numpy())
    np.testing.assert_allclose(ours.scores, out.iou_scores[0, :, 0].numpy(), atol=1e-6)


@pytest.mark.parametrize("wh", SIZES_WH)
def test_sam2s_masks_are_the_librarys_model_on_the_same_pixels(wh):
    """Its processor needs torchvision; what it does with boxes and masks is written out here."""
    from transformers import Sam2Model

    image = picture(*wh)
    sam = SegmentAnything(model("sam2"), device="cpu")
    network = Sam2Model.from_pretrained(model("sam2")).eval()
    pixels = torch.from_numpy(sam._input(image).pixels)[None]
    scale = torch.tensor([128 / wh[0], 128 / wh[1]] * 2)
    with torch.no_grad():
        out = network(
            pixel_values=pixels, input_boxes=torch.from_numpy(boxes(wh))[None] * scale, multimask_output=False
        )
    full = torch.nn.functional.interpolate(out.pred_masks[0], wh[::-1], mode="bilinear", align_corners=False)
    ours = sam.masks(image, boxes(wh))
    assert (ours.masks == (full[:, 0] > 0).numpy()).mean() > 0.9999
    np.testing.assert_allclose(ours.scores, out.iou_scores[0, :, 0].numpy(), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_together_are_each_box_alone(kind):
    sam, image = SegmentAnything(model(kind), device="cpu"), picture(640, 480)
    together = sam.masks(image, boxes((640, 480), 9))
    for i, box in enumerate(boxes((640, 480), 9)):
        alone = sam.masks(image, box[None])
        assert (alone.masks[0] == together.masks[i]).mean() > 0.9999


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_is_encoded_once(kind):
    sam = SegmentAnything(model(kind), device="cpu")
    calls: list[int] = []
    sam.encoder.register_forward_hook(lambda *_: calls.append(1))
    first, second = picture(224, 224), picture(224, 224, seed=1)
    before = sam.masks(first, boxes((224, 224)))
    sam.masks(first.copy(), boxes((224, 224), 1))
    sam.masks(second, boxes((224, 224)))
    after = sam.masks(first, boxes((224, 224)))
    assert len(calls) == 2
    np.testing.assert_array_equal(before.masks, after.masks)


@pytest.mark.parametrize("kind", KINDS)
def test_no_boxes_no_masks_and_no_work(kind):
    sam = SegmentAnything(model(kind), device="cpu")
    calls: list[int] = []
    sam.encoder.register_forward_hook(lambda *_: calls.append(1))
    found = sam.masks(picture(224, 224), np.zeros((0, 4), np.float32))
    assert found.masks.shape == (0, 224, 224)
    assert found.scores.shape == (0,)
    assert not calls


@pytest.mark.parametrize("kind", KINDS)
def test_half_precision(kind):
    found = SegmentAnything(model(kind), device="cpu", dtype="bfloat16").masks(picture(224, 224), boxes((224, 224)))
    assert found.scores.dtype == np.float32
    assert np.isfinite(found.scores).all()


@needs_gpu
@pytest.mark.parametrize("wh", SIZES_WH)
@pytest.mark.parametrize("kind", KINDS)
def test_a_gpu_gives_the_same(kind, wh):
    expected = SegmentAnything(model(kind), device="cpu").masks(picture(*wh), boxes(wh, 11))
    found = SegmentAnything(model(kind), device="cuda").masks(picture(*wh), boxes(wh, 11))
    assert (found.masks == expected.masks).mean() > 0.999
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    for dtype in ("bfloat16", "float16"):
        half = SegmentAnything(model(kind), device="cuda", dtype=dtype).masks(picture(*wh), boxes(wh, 11))
        assert np.isfinite(half.scores).all()


def test_the_same_model_is_held_once_while_it_is_in_use():
    first = SegmentAnything.shared(model("sam"), device="cpu")
    assert SegmentAnything.shared(model("sam"), device="cpu") is first
    assert SegmentAnything.shared(model("sam2"), device="cpu") is not first
    left = weakref.ref(first)
    del first
    gc.collect()
    assert left() is None, "nothing keeps the weights once no segmenter uses them"
