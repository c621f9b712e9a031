"""CLIP's text tower: the original's numbers, from every kind of file, and clear errors."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden, save_tokenizer, tower_weights  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks.clip_text import ClipText, load_text_tower, text_weights  # noqa: E402


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> tuple[Path, int]:
    folder = tmp_path_factory.mktemp("tokenizer")
    return folder, save_tokenizer(folder)


def test_the_tower_is_the_originals():
    g = golden("golden_text")
    weights = {k.removeprefix("small/w/"): torch.from_numpy(g[k]).float() for k in g.files if k.startswith("small/w/")}
    tower = load_text_tower(weights, heads=json.loads(str(g["meta_json"]))["small"]["transformer_heads"])
    with torch.no_grad():
        got = tower(input_ids=torch.from_numpy(g["small/ids"]).long()).text_embeds
    np.testing.assert_allclose(got, g["small/out"], atol=5e-6, rtol=1e-5)


def test_real_token_ids_are_the_originals():
    """With the folder of CLIP's own tokeniser in THINKGRASP_CLIP_TOKENIZER."""
    folder = os.environ.get("THINKGRASP_CLIP_TOKENIZER")
    if not folder:
        pytest.skip("THINKGRASP_CLIP_TOKENIZER names no folder with CLIP's vocab.json and merges.txt")
    g = golden("golden_text")
    tower = ClipText(tower_weights(49408, layers=1), tokenizer=folder)
    np.testing.assert_array_equal(tower.token_ids(json.loads(str(g["tok/texts_json"]))), g["tok/ids"])


def test_the_real_tower_meets_upstreams_vectors():
    """With RN50.pt in THINKGRASP_CLIP_RN50 too; upstream's were made in half precision."""
    folder, weights = os.environ.get("THINKGRASP_CLIP_TOKENIZER"), os.environ.get("THINKGRASP_CLIP_RN50")
    if not folder or not weights:
        pytest.skip("THINKGRASP_CLIP_TOKENIZER and THINKGRASP_CLIP_RN50 do not name CLIP's tokeniser and RN50.pt")
    g = golden("golden_text")
    tower = ClipText(text_weights(weights), tokenizer=folder)
    features = tower.encode(tower.token_ids(json.loads(str(g["rn50/sentences_json"]))))
    wanted = torch.from_numpy(g["rn50/features"]).float()
    assert torch.cosine_similarity(features, wanted).min() > 0.9995


def test_sizes_come_from_the_weights(tokenizer):
    folder, count = tokenizer
    tower = ClipText(tower_weights(count, width=128, out=40, layers=3), tokenizer=folder)
    ids = tower.token_ids(["a mug handle", "background"])
    assert ids.shape == (2, 77)
    assert ids[0].argmax() == 4
    assert ids[0, 0] == count - 2
    assert ids[0, 4] == count - 1
    assert not ids[0, 5:].any()
    features = tower.encode(ids)
    assert features.shape == (2, 40)
    assert tower.width == 40
    torch.testing.assert_close(features, tower.encode(ids))


def test_the_digest_tells_weights_apart(tokenizer):
    folder, count = tokenizer
    weights = tower_weights(count)
    first, same = (ClipText(weights, tokenizer=folder).digest for _ in range(2))
    weights["ln_final.bias"] = weights["ln_final.bias"] + 1e-3
    assert first == same != ClipText(weights, tokenizer=folder).digest


def test_a_long_sentence_is_refused_not_cut(tokenizer):
    folder, count = tokenizer
    tower = ClipText(tower_weights(count), tokenizer=folder)
    with pytest.raises(InputError, match="at most 77"):
        tower.token_ids(["mug " * 90])


def test_every_kind_of_file(tmp_path):
    weights = tower_weights(300)
    extra = {"visual.conv1.weight": torch.ones(2, 2), "logit_scale": torch.ones(())}
    torch.save({**weights, **extra}, tmp_path / "plain.pt")
    torch.save({"model": {f"text_encoder.{k}": v for k, v in weights.items()} | extra}, tmp_path / "vlpart.pth")
    torch.save({**{k: v.half() for k, v in weights.items()}, **extra}, tmp_path / "half.pt")
    pytest.importorskip("safetensors.torch").save_file({**weights, **extra}, tmp_path / "w.safetensors")
    for name in ("plain.pt", "vlpart.pth", "half.pt", "w.safetensors"):
        found = text_weights(tmp_path / name)
        assert set(found) == set(weights)
        for key, value in weights.items():
            assert found[key].dtype == torch.float32
            torch.testing.assert_close(found[key], value, atol=2e-3, rtol=2e-3)


class Tower(torch.nn.Module):
    """Named as OpenAI's module, with an image part beside the text."""

    def __init__(self, weights) -> None:
        super().__init__()
        self.visual = torch.nn.Linear(2, 3)
        self.input_resolution = 224
        for name, value in weights.items():
            *path, last = name.split(".")
            place: torch.nn.Module = self
            for part in path:
                if not hasattr(place, part):
                    place.add_module(part, torch.nn.Module())
                place = getattr(place, part)
            place.register_parameter(last, torch.nn.Parameter(value.half()))

    def forward(self, x):
        return self.visual(x)


def test_openais_archive_is_read_without_running_it(tmp_path):
    weights = tower_weights(300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(Tower(weights)), tmp_path / "RN50.pt")
    found = text_weights(tmp_path / "RN50.pt")
    assert set(found) == set(weights)
    for key, value in weights.items():
        torch.testing.assert_close(found[key], value.half().float())
    load_text_tower(found)


@pytest.mark.parametrize("name", ["absent.pt", "notes.txt", "other.pt"])
def test_a_file_without_a_tower_is_named(tmp_path, name):
    (tmp_path / "notes.txt").write_text("hello")
    torch.save({"weight": torch.ones(2)}, tmp_path / "other.pt")
    with pytest.raises(ConfigError, match=f"CLIP text tower: .*{name}"):
        text_weights(tmp_path / name)


def test_incomplete_weights_are_refused():
    weights = tower_weights(300)
    for gone, message in (
        ("text_projection", "lack text_projection"),
        ("ln_final.bias", "1 of 37 tensors are missing"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_text_tower({k: v for k, v in weights.items() if k != gone})


def test_a_tokeniser_that_is_not_there_or_not_this_models(tmp_path, tokenizer):
    weights = tower_weights(300)
    for nothing in (tmp_path, tmp_path / "absent"):
        with pytest.raises(ConfigError, match=r"cannot be loaded .*hf download openai/clip-vit-base-patch32"):
            ClipText(weights, tokenizer=nothing)
    folder, count = tokenizer
    with pytest.raises(ConfigError, match=rf"has {count} tokens, the weights are for 300"):
        ClipText(weights, tokenizer=folder)
