"""Weights, text and image together: what is found, what is remembered, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import TINY, save_checkpoint, save_tokenizer, tiny_weights, tower_weights  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks.part_finder import PartFinder, TextSource  # noqa: E402

RGB = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return save_checkpoint(tmp_path_factory.mktemp("vlpart"))


def finder(files, **settings) -> PartFinder:
    weights, tokenizer = files
    return PartFinder(weights, TextSource(tokenizer=tokenizer), config=TINY, device="cpu", **settings)


def test_boxes_come_best_first_with_their_names(files):
    found = finder(files).find(RGB, ["mug:handle", "knife"])
    assert set(found.names) == {"mug:handle", "knife"}
    assert found.boxes_xyxy.shape == (len(found.names), 4)
    assert found.boxes_xyxy.dtype == found.scores.dtype == np.float32
    assert (np.diff(found.scores) <= 0).all()
    assert (found.boxes_xyxy >= 0).all()
    assert (found.boxes_xyxy <= [80, 60, 80, 60]).all()


def test_names_in_one_text_are_split_at_full_stops(files):
    parts = finder(files)
    listed, text = parts.find(RGB, ["mug:handle", "knife"]), parts.find(RGB, "mug:handle.knife.")
    assert listed.names == text.names
    np.testing.assert_array_equal(listed.boxes_xyxy, text.boxes_xyxy)


def test_without_names_nothing_is_found(files):
    assert len(finder(files).find(RGB, []).boxes_xyxy) == 0


def test_the_image_is_looked_at_once(files, monkeypatch):
    parts = finder(files)
    looked = []
    regions = parts.model.regions
    monkeypatch.setattr(parts.model, "regions", lambda rgb: looked.append(rgb) or regions(rgb))
    first = parts.find(RGB, ["mug"])
    parts.find(RGB.copy(), ["knife"])
    again = parts.find(RGB, ["mug"])
    assert len(looked) == 1
    np.testing.assert_array_equal(first.boxes_xyxy, again.boxes_xyxy)
    changed = RGB.copy()
    changed[0, 0] ^= 255
    parts.find(changed, ["mug"])
    parts.find(RGB, ["mug"])
    assert len(looked) == 2
    parts.find(RGB[:50], ["mug"])
    parts.find(changed, ["mug"])
    assert len(looked) == 4


def test_every_source_of_text_gives_the_same(files, tmp_path):
    weights, tokenizer = files
    inside = finder(files)
    torch.save(tower_weights(save_tokenizer(tmp_path / "t")), tmp_path / "tower.pt")
    torch.save(tiny_weights(), tmp_path / "bare.pth")
    source = TextSource(weights=tmp_path / "tower.pt", tokenizer=tokenizer, cache=tmp_path / "cache")
    beside = PartFinder(tmp_path / "bare.pth", source, config=TINY, device="cpu")
    sentences = ["a mug handle", "background"]
    vectors = inside._text.features(sentences).numpy()
    np.savez(tmp_path / "table.npz", names=np.array(["mug:handle", "background"]), features=vectors)
    table = PartFinder(weights, TextSource(table=tmp_path / "table.npz"), config=TINY, device="cpu")
    results = [f.find(RGB, ["mug:handle"]) for f in (inside, beside, table)]
    for other in results[1:]:
        np.testing.assert_allclose(other.boxes_xyxy, results[0].boxes_xyxy)
        np.testing.assert_allclose(other.scores, results[0].scores)
    assert inside.unused == beside.unused == ()
    assert all(name.startswith("text_encoder.") for name in table.unused)
    with pytest.raises(InputError, match="not among the 2 names"):
        table.find(RGB, ["spoon"])


def test_both_variants_and_what_the_config_says(files):
    paper, upstream = finder(files), finder(files, variant="upstream")
    assert upstream.model.config.selection.uses_objectness
    assert finder(files, variant=None).model.config.selection == paper.model.config.selection
    assert not np.array_equal(paper.find(RGB, ["mug"]).scores, upstream.find(RGB, ["mug"]).scores)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_other_number_formats(files, dtype):
    found = finder(files, dtype=dtype).find(RGB, ["mug"])
    assert len(found.boxes_xyxy)
    assert np.isfinite(found.scores).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dtype": "int8"}, "dtype must be one of float32"),
        ({"variant": "theirs"}, "variant must be one of paper, upstream"),
        ({"device": "toaster"}, "cannot be used here"),
        ({"config": None}, "weights of another model"),
    ],
)
def test_bad_settings(files, settings, message):
    weights, tokenizer = files
    with pytest.raises(ConfigError, match=message):
        PartFinder(weights, TextSource(tokenizer=tokenizer), **{"config": TINY, "device": "cpu"} | settings)


def test_text_that_is_missing_or_does_not_fit(files, tmp_path):
    weights, tokenizer = files
    torch.save(tiny_weights(), tmp_path / "bare.pth")
    with pytest.raises(ConfigError, match=r"holds no text tower .*RN50\.pt"):
        PartFinder(tmp_path / "bare.pth", TextSource(tokenizer=tokenizer), config=TINY, device="cpu")
    wide = tower_weights(save_tokenizer(tmp_path / "t"), out=48)
    torch.save(wide, tmp_path / "wide.pt")
    source = TextSource(weights=tmp_path / "wide.pt", tokenizer=tokenizer)
    with pytest.raises(ConfigError, match="have 48 numbers; the detector compares 24"):
        PartFinder(weights, source, config=TINY, device="cpu")
    np.savez(tmp_path / "t.npz", names=np.array(["mug"]), features=np.ones((1, 5)))
    with pytest.raises(ConfigError, match="have 5 numbers"):
        PartFinder(weights, TextSource(table=tmp_path / "t.npz"), config=TINY, device="cpu")
    with pytest.raises(ConfigError, match="not both"):
        TextSource(weights="a", table="b")
