"""A model is read whole and safely, or there is one clear error when it is loaded."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys

import pytest
from fakes.models import model, picture

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from thinkgrasp.errors import ConfigError, MissingDependency  # noqa: E402
from thinkgrasp.segmenters.grounding_dino import GroundingDino  # noqa: E402
from thinkgrasp.segmenters.pretrained import import_models  # noqa: E402
from thinkgrasp.segmenters.segment_anything import SegmentAnything  # noqa: E402


@pytest.fixture
def sam(tmp_path):
    """A copy of the small SAM to spoil."""
    folder = tmp_path / "sam"
    shutil.copytree(model("sam"), folder)
    return folder


def spoil_weights(folder):
    st = pytest.importorskip("safetensors.torch", reason="needs thinkgrasp[langsam]")
    weights = st.load_file(folder / "model.safetensors")
    del weights["mask_decoder.iou_token.weight"], weights["vision_encoder.pos_embed"]
    st.save_file(weights, folder / "model.safetensors", {"format": "pt"})


def reshape_weights(folder):
    st = pytest.importorskip("safetensors.torch", reason="needs thinkgrasp[langsam]")
    weights = st.load_file(folder / "model.safetensors")
    weights["mask_decoder.iou_token.weight"] = torch.zeros(1, 7)
    st.save_file(weights, folder / "model.safetensors", {"format": "pt"})


def config(text):
    return lambda folder: (folder / "config.json").write_text(text)


class Harmful:
    def __reduce__(self):
        return (open, ("never", "w"))


def harmful_pickle(folder):
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model.bin").write_bytes(pickle.dumps({"w": Harmful()}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "model.safetensors").unlink(), "holds a config.json but no weights"),
        (lambda f: (f / "model.safetensors").write_bytes(b"\x01" * 50), "cannot be loaded"),
        (lambda f: (f / "model.safetensors").write_bytes(b""), "cannot be loaded"),
        (lambda f: (f / "config.json").unlink(), "holds no config.json"),
        (config("{"), "cannot be read"),
        (config("[]"), "names no model_type"),
        (config("{}"), "names no model_type"),
        (config('{"model_type": "bert"}'), "holds a 'bert' model; allowed: sam, sam2, sam2_video"),
        (config('{"model_type": "sam", "vision_config": 3}'), "cannot be loaded"),
        (spoil_weights, r"lack 2 tensors \(mask_decoder.iou_token.weight, vision_encoder.pos_embed\)"),
        (reshape_weights, "cannot be loaded"),
        (harmful_pickle, "cannot be loaded"),
    ],
)
def test_a_bad_folder_is_named_when_it_is_loaded(sam, spoil, message, monkeypatch):
    monkeypatch.chdir(sam)
    spoil(sam)
    with pytest.raises(ConfigError, match=message) as error:
        SegmentAnything(sam, device="cpu")
    assert str(sam) in str(error.value)
    assert "Segment Anything" in str(error.value)
    assert not (sam / "never").exists(), "code in a file is not run"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("{tmp}/nothing", "there is no folder .*nothing, and no model of that name"),
        ("{tmp}", "holds no config.json"),
        ("{tmp}/a-file", "is a file; give the folder"),
        ("sam-vit-base", r"not on this machine .*; get it with: hf download facebook/sam-vit-base --revision 70c1a07"),
        ("facebook/sam-vit-huge", "hf download facebook/sam-vit-huge --revision 87aecf0"),
    ],
)
def test_what_is_not_there_is_named_with_the_command_that_gets_it(tmp_path, monkeypatch, source, message):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("THINKGRASP_WEIGHTS", str(tmp_path / "weights"))
    (tmp_path / "a-file").touch()
    with pytest.raises(ConfigError, match=message):
        SegmentAnything(source.format(tmp=tmp_path), device="cpu")


def test_plain_pickled_weights_are_read(sam):
    st = pytest.importorskip("safetensors.torch", reason="needs thinkgrasp[langsam]")
    torch.save(st.load_file(sam / "model.safetensors"), sam / "pytorch_model.bin")
    (sam / "model.safetensors").unlink()
    boxes = torch.tensor([[10.0, 20, 200, 190]]).numpy()
    ours, plain = (SegmentAnything(f, device="cpu").masks(picture(224, 224), boxes) for f in (model("sam"), sam))
    assert (ours.masks == plain.masks).all()


def test_sam2_is_read_as_it_is_published(tmp_path):
    """Its configuration on the hub is that of the video model, which holds more than pictures need."""
    folder = tmp_path / "sam2"
    shutil.copytree(model("sam2"), folder)
    settings = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(settings | {"model_type": "sam2_video", "num_maskmem": 7}))
    boxes = torch.tensor([[10.0, 20, 200, 190]]).numpy()
    ours, video = (SegmentAnything(f, device="cpu").masks(picture(224, 224), boxes) for f in (model("sam2"), folder))
    assert (ours.masks == video.masks).all()


def test_a_missing_tokenizer_is_named(tmp_path):
    folder = tmp_path / "dino"
    shutil.copytree(model("grounding_dino"), folder)
    for name in ("tokenizer.json", "tokenizer_config.json", "vocab.txt"):
        (folder / name).unlink(missing_ok=True)
    with pytest.raises(ConfigError, match="tokenizer"):
        GroundingDino(folder, device="cpu")


def test_a_missing_library_is_named_with_its_extra():
    def load():
        raise ModuleNotFoundError("No module named 'transformers'", name="transformers")

    with pytest.raises(MissingDependency, match=r"test needs the package 'transformers'.*thinkgrasp\[langsam\]"):
        import_models(load, what="test")


@pytest.mark.parametrize("package", ["torch", "transformers"])
@pytest.mark.parametrize("plugin", ["grounded_sam", "sam3"])
def test_without_the_extra_a_plugin_names_it(tmp_path, package, plugin):
    """In a process where the package is not to be found."""
    code = f"""
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name={package!r})
sys.meta_path.insert(0, Hidden())
from thinkgrasp import registry
from thinkgrasp.errors import MissingDependency
try:
    registry.load("segmenter", {plugin!r})
except MissingDependency as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert f"needs the package {package!r}" in done.stdout
    assert "pip install 'thinkgrasp[langsam]'" in done.stdout


def test_loading_says_nothing_on_stdout_and_stderr(capfd):
    SegmentAnything(model("sam"), device="cpu")
    GroundingDino(model("grounding_dino"), device="cpu")
    assert capfd.readouterr() == ("", "")
