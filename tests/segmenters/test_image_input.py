"""Images as networks take them: the very numbers of the library's own processors, where these run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes.models import SIZES_WH, model, picture

from thinkgrasp.errors import ConfigError
from thinkgrasp.segmenters.image_cache import ImageCache
from thinkgrasp.segmenters.image_input import ImageInput

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

ODD_WH = [(97, 331), (333, 100), (64, 64), (1333, 799), (800, 800)]
DINO = ImageInput({"shortest_edge": 800, "longest_edge": 1333})
SAM = ImageInput({"longest_edge": 1024}, pad_hw=(1024, 1024))


@pytest.mark.parametrize("wh", [*SIZES_WH, *ODD_WH])
def test_grounding_dinos_input_is_the_librarys(wh):
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil

    image = picture(*wh)
    expected = GroundingDinoImageProcessorPil()(images=image, return_tensors="np")
    ours = DINO(image)
    np.testing.assert_array_equal(ours.pixels, expected["pixel_values"][0])
    assert expected["pixel_mask"].all()
    assert ours.size_hw == ours.pixels.shape[1:]


@pytest.mark.parametrize("wh", [*SIZES_WH, *ODD_WH])
def test_sams_input_is_the_librarys(wh):
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    image = picture(*wh)
    expected = SamImageProcessorPil()(images=image, return_tensors="np")
    ours = SAM(image)
    np.testing.assert_array_equal(ours.pixels, expected["pixel_values"][0])
    assert ours.size_hw == tuple(expected["reshaped_input_sizes"][0])


@pytest.mark.parametrize("wh", SIZES_WH)
@pytest.mark.parametrize("side", [1008, 1024])
def test_resizing_differs_from_torchs_by_two_grey_levels_at_most(wh, side):
    """SAM 2's and SAM 3's processors resize with torchvision, which calls this function."""
    image = picture(*wh)
    ours = ImageInput({"height": side, "width": side}, mean=(0, 0, 0), std=(1, 1, 1), scale=1)(image).pixels
    tensor = torch.from_numpy(image.copy()).permute(2, 0, 1)[None]
    theirs = torch.nn.functional.interpolate(tensor, (side, side), mode="bilinear", antialias=True)[0].numpy()
    difference = np.abs(ours - theirs.astype(np.float32))
    assert difference.max() <= 2
    assert difference.mean() < 0.1


@pytest.mark.parametrize("kind", ["grounding_dino", "sam", "sam2", "sam3"])
def test_settings_come_from_the_models_folder(kind):
    folder = model(kind)
    written = json.loads((folder / "preprocessor_config.json").read_text())
    read = ImageInput({"height": 1, "width": 1}, pad_hw=(1, 1)).read(folder, what="test")
    assert read.size == written["size"]
    assert list(read.mean) == written.get("image_mean", [0.485, 0.456, 0.406])
    assert read.pad_hw == ((128, 128) if kind == "sam" else (1, 1))


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("preprocessor_config.json", {"size": {"height": 64, "width": 32, "longest_edge": None}}, (64, 32)),
        ("processor_config.json", {"image_processor": {"size": {"height": 5, "width": 7}}, "target_size": 9}, (5, 7)),
        ("other.json", {}, (1, 1)),
    ],
)
def test_settings_are_found_in_either_file(tmp_path, name, content, expected):
    (tmp_path / name).write_text(json.dumps(content))
    assert ImageInput({"height": 1, "width": 1}).read(tmp_path, what="test").resized_hw((10, 10)) == expected


@pytest.mark.parametrize(
    "content",
    [
        "{",
        '{"size": {"tallest": 4}}',
        '{"size": 7}',
        '{"size": {"height": "tall", "width": 3}}',
        '{"image_mean": [0.5]}',
        '{"image_std": 3}',
        '{"rescale_factor": "x"}',
    ],
)
def test_settings_that_cannot_be_used_are_named(tmp_path, content):
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(ConfigError, match=f"test: .*{tmp_path}"):
        ImageInput({"longest_edge": 64}).read(tmp_path, what="test")


def test_the_cache_knows_images_by_their_pixels():
    cache, made = ImageCache[int](2), []
    images = [picture(8, 6, seed) for seed in range(3)]

    def ask(image):
        return cache.get(image, lambda: made.append(1) or len(made))

    assert [ask(images[0]), ask(images[0]), ask(images[0].copy())] == [1, 1, 1]
    assert [ask(images[1]), ask(images[0]), ask(images[2]), ask(images[0])] == [2, 1, 3, 1]
    assert ask(images[1]) == 4, "the image that was not asked about longest goes first"
    changed = images[0].copy()
    changed[0, 0, 0] ^= 1
    assert ask(changed) == 5
    assert ask(np.ascontiguousarray(images[0].reshape(8, 6, 3))) == 6, "the same bytes in another shape"


def test_a_cache_of_no_size_keeps_nothing():
    cache = ImageCache[int](0)
    assert [cache.get(picture(8, 6), lambda: 1), cache.get(picture(8, 6), lambda: 2)] == [1, 2]
