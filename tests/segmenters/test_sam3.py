"""SAM 3 without torchvision, on a small network with random weights."""

from __future__ import annotations

import json
import math
import shutil

import numpy as np
import pytest
from fakes.gpu import needs_gpu
from fakes.models import SIZES_WH, model, picture

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from thinkgrasp.errors import ConfigError  # noqa: E402
from thinkgrasp.segmenters.sam3 import Sam3Segmenter  # noqa: E402
from thinkgrasp.segmenters.sam3_network import Sam3, roi_align  # noqa: E402
from thinkgrasp.testing import sample_scene, strict_scene  # noqa: E402
from thinkgrasp.types import Plan  # noqa: E402

PHRASES = ("red mug", "a box")
BOXES = np.array([[10, 20, 120, 150], [50, 30, 200, 210], [0, 0, 30, 30]], np.float32)


def network(**settings) -> Sam3:
    return Sam3(model("sam3"), device="cpu", **{"score_threshold": 0.0, **settings})


def torchvisions_roi_align(features: np.ndarray, box: np.ndarray, size: int) -> np.ndarray:
    """One box, sample by sample, as torchvision documents `aligned=False, sampling_ratio=-1`."""
    channels, height, width = features.shape
    x0, y0, x1, y1 = map(float, box)
    sides = max(x1 - x0, 1.0), max(y1 - y0, 1.0)
    n = [math.ceil(side / size) for side in sides]
    out = np.zeros((channels, size, size))
    for row in range(size):
        for column in range(size):
            for j in range(n[1]):
                for i in range(n[0]):
                    y = y0 + (row + (j + 0.5) / n[1]) * sides[1] / size
                    x = x0 + (column + (i + 0.5) / n[0]) * sides[0] / size
                    if y < -1 or y > height or x < -1 or x > width:
                        continue
                    y, x = min(max(y, 0.0), height - 1), min(max(x, 0.0), width - 1)
                    top, left = int(y), int(x)
                    below, right = min(top + 1, height - 1), min(left + 1, width - 1)
                    dy, dx = y - top, x - left
                    upper = features[:, top, left] * (1 - dx) + features[:, top, right] * dx
                    lower = features[:, below, left] * (1 - dx) + features[:, below, right] * dx
                    out[:, row, column] += (upper * (1 - dy) + lower * dy) / (n[0] * n[1])
    return out


@pytest.mark.parametrize(
    "box",
    [
        [2, 3, 9, 8],
        [0, 0, 12, 10],
        [5.2, 1.7, 5.4, 1.9],
        [-3, -2, 4, 5],
        [8, 6, 20, 19],
        [30, 30, 40, 40],
        [3, 3, 3, 3],
    ],
)
def test_box_features_are_torchvisions(box):
    features = np.random.default_rng(0).normal(size=(4, 10, 12)).astype(np.float32)
    ours = roi_align(torch.from_numpy(features)[None], torch.tensor([box]), 3)
    np.testing.assert_allclose(ours[0].numpy(), torchvisions_roi_align(features, np.array(box), 3), atol=1e-5)


def test_no_box_no_features():
    assert roi_align(torch.zeros(0, 4, 10, 12), torch.zeros(0, 4), 3).shape == (0, 4, 3, 3)


@pytest.mark.parametrize("wh", SIZES_WH)
def test_masks_of_phrases(wh):
    found = network().find(picture(*wh), PHRASES)
    again = network().find(picture(*wh), PHRASES)
    for one, same in zip(found, again, strict=True):
        assert one.masks.shape == (len(one.scores), wh[1], wh[0])
        assert one.masks.dtype == np.bool_
        assert len(one.scores) == 12
        assert list(one.scores) == sorted(one.scores, reverse=True)
        assert ((one.scores >= 0) & (one.scores <= 1)).all()
        np.testing.assert_array_equal(one.masks, same.masks)
        np.testing.assert_array_equal(one.scores, same.scores)


@pytest.mark.parametrize("wh", SIZES_WH)
def test_the_librarys_model_on_the_same_pixels_says_the_same(wh):
    """Post-processing as the library's processor documents it, which itself cannot be imported here."""
    from transformers import AutoTokenizer, Sam3Model

    sam, image = network(), picture(*wh)
    theirs = Sam3Model.from_pretrained(model("sam3")).eval()
    text = AutoTokenizer.from_pretrained(model("sam3"))(
        ["red mug"], padding="max_length", max_length=32, return_tensors="pt"
    )
    pixels = torch.from_numpy(sam._input(image).pixels)[None]
    with torch.no_grad():
        out = theirs(pixel_values=pixels, input_ids=text["input_ids"], attention_mask=text["attention_mask"])
    scores = (out.pred_logits.sigmoid() * out.presence_logits.sigmoid())[0]
    order = torch.argsort(scores, descending=True, stable=True)
    full = torch.nn.functional.interpolate(out.pred_masks.sigmoid(), wh[::-1], mode="bilinear", align_corners=False)
    (ours,) = sam.find(image, ["red mug"])
    np.testing.assert_allclose(ours.scores, scores[order].numpy(), atol=1e-6)
    assert (ours.masks == (full[0, order] > 0.5).numpy()).mean() > 0.9999


def test_phrases_together_are_each_phrase_alone_and_the_image_is_encoded_once():
    sam, image = network(batch=3), picture(640, 480)
    calls: list[int] = []
    sam.encoder.register_forward_hook(lambda *_: calls.append(1))
    together = sam.find(image, ("red mug", "a rather longer phrase", "x"))
    for phrase, found in zip(("red mug", "a rather longer phrase", "x"), together, strict=True):
        (alone,) = network(batch=1).find(image, [phrase])
        np.testing.assert_allclose(alone.scores, found.scores, atol=1e-5)
        assert (alone.masks == found.masks).mean() > 0.999
    sam.masks(image.copy(), BOXES)
    assert len(calls) == 1
    sam.find(picture(640, 480, seed=1), ["x"])
    assert len(calls) == 2


@pytest.mark.parametrize("wh", SIZES_WH)
def test_one_mask_per_box(wh):
    found = network().masks(picture(*wh), BOXES)
    assert found.masks.shape == (3, wh[1], wh[0])
    assert found.scores.shape == (3,)
    alone = network(batch=1).masks(picture(*wh), BOXES[1:2])
    assert (alone.masks[0] == found.masks[1]).mean() > 0.999
    assert network().masks(picture(*wh), BOXES[:0]).masks.shape == (0, wh[1], wh[0])


def test_a_threshold_and_a_limit():
    image = picture(224, 224)
    (everything,) = network().find(image, ["red mug"])
    limit = float(np.median(everything.scores))
    (some,) = network(score_threshold=limit).find(image, ["red mug"])
    np.testing.assert_array_equal(some.scores, everything.scores[everything.scores > limit])
    assert len(network().find(image, ["red mug"], most=2)[0].scores) == 2
    assert network(score_threshold=1.0).find(image, ["red mug"])[0].masks.shape == (0, 224, 224)


def test_half_precision():
    sam = network(dtype="bfloat16")
    assert np.isfinite(sam.find(picture(224, 224), ["red mug"])[0].scores).all()
    assert np.isfinite(sam.masks(picture(224, 224), BOXES).scores).all()


@needs_gpu
@pytest.mark.parametrize("wh", SIZES_WH)
def test_a_gpu_gives_the_same(wh):
    on_gpu = Sam3(model("sam3"), device="cuda", score_threshold=0.0)
    for expected, found in zip(network().find(picture(*wh), PHRASES), on_gpu.find(picture(*wh), PHRASES), strict=True):
        np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
        assert (found.masks == expected.masks).mean() > 0.999
    by_box, on_it = network().masks(picture(*wh), BOXES), on_gpu.masks(picture(*wh), BOXES)
    np.testing.assert_allclose(on_it.scores, by_box.scores, atol=1e-4)
    assert (on_it.masks == by_box.masks).mean() > 0.999
    for dtype in ("bfloat16", "float16"):
        half = Sam3(model("sam3"), device="cuda", dtype=dtype, score_threshold=0.0)
        assert np.isfinite(half.find(picture(*wh), PHRASES)[0].scores).all()


def test_the_published_layout_with_its_tracker_is_read(tmp_path):
    """On the hub the detector's weights stand under detector_model, beside a tracker that is not needed."""
    safetensors = pytest.importorskip("safetensors.torch", reason="needs thinkgrasp[langsam]")
    source = model("sam3")
    for file in source.iterdir():
        shutil.copy(file, tmp_path)
    weights = safetensors.load_file(source / "model.safetensors")
    published = {f"detector_model.{name}": value for name, value in weights.items()}
    published["tracker_model.memory.weight"] = torch.zeros(2, 2)
    safetensors.save_file(published, tmp_path / "model.safetensors", {"format": "pt"})
    config = json.loads((source / "config.json").read_text())
    (tmp_path / "config.json").write_text(
        json.dumps({"model_type": "sam3_video", "architectures": ["Sam3VideoModel"], "detector_config": config})
    )
    image = picture(224, 224)
    published_one, own = Sam3(tmp_path, device="cpu", score_threshold=0.0), network()
    np.testing.assert_array_equal(
        published_one.find(image, ["red mug"])[0].scores, own.find(image, ["red mug"])[0].scores
    )


class TestSegmenter:
    def test_all_masks_of_a_text_best_first(self):
        plan = Plan("red mug", "")
        found = Sam3Segmenter(model=network(), max_segments=4).segment(strict_scene(), plan)
        assert 0 < len(found.segments) <= 4
        assert [s.score for s in found.segments] == sorted((s.score for s in found.segments), reverse=True)
        assert all(s.label == "red mug" and s.mask.shape == (240, 320) for s in found.segments)

    def test_nothing_found_is_said(self):
        found = Sam3Segmenter(model=network(score_threshold=1.0)).segment(strict_scene(), Plan("red mug", ""))
        assert found.segments == ()
        assert found.degraded[0].reason == "no mask answers to 'red mug'"

    def test_blank_phrases_find_nothing_and_keep_their_place(self):
        segmenter = Sam3Segmenter(model=network())
        found = segmenter.find(picture(224, 224), ["", "red mug", " "])
        assert (found[0], found[2]) == ((), ())
        assert found[1]

    def test_a_mark_is_its_proposal(self):
        scene = sample_scene()
        found = Sam3Segmenter(model=network()).segment(scene, Plan("thing", "", mark=2))
        assert [s.mark for s in found.segments] == [2]
        assert found.segments[0].mask is scene.proposal(2).mask

    @pytest.mark.parametrize("settings", [{"score_threshold": 2}, {"max_segments": 0}, {"model": "no such model"}])
    def test_settings_are_checked(self, settings):
        with pytest.raises(ConfigError, match=r"sam3|SAM 3"):
            Sam3Segmenter(**settings)


def test_a_text_beyond_the_limit_is_said_to_be_cut():
    segmenter = Sam3Segmenter(model=network())
    short = segmenter.segment(strict_scene(), Plan("red mug", ""))
    assert short.degraded == ()
    words = " ".join(f"mug{i}" for i in range(40))
    found = segmenter.segment(strict_scene(), Plan(words, ""))
    (said,) = found.degraded
    assert said.reason.startswith("the text is longer than the 32 tokens that are read; not read: '")
    assert said.fallback == "the text before that"
    assert segmenter.network.unread(words).rstrip(".") in words
