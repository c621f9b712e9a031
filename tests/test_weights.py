"""What is known of weights, and where they are found."""

from __future__ import annotations

import re

import pytest

from thinkgrasp import weights
from thinkgrasp.errors import ConfigError
from thinkgrasp.weights import known_weights, locate_model

COMMIT = "a" * 40


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty machine."""
    for name in ("HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME", "THINKGRASP_WEIGHTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def put_in_cache(cache, hub: str, revision: str, *names: str):
    folder = cache / f"models--{hub.replace('/', '--')}" / "snapshots" / revision
    folder.mkdir(parents=True)
    for name in names or ("config.json", "model.safetensors"):
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("entry", known_weights().values(), ids=lambda e: e.name)
def test_each_entry_says_what_it_is_and_how_to_get_it(entry, here):
    assert entry.purpose
    assert entry.licence
    assert entry.find() is None
    if entry.hub:
        assert re.fullmatch(r"[0-9a-f]{40}", entry.revision), "pinned to a commit"
        assert f"hf download {entry.hub} --revision {entry.revision}" in entry.command
        assert entry.command.startswith("hf auth login") == entry.gated
        return
    assert entry.file
    assert sum(source is not None for source in (entry.url, entry.drive, entry.page)) == 1
    assert entry.url is None or entry.url.startswith("https://")
    assert str(here / ".cache" / "thinkgrasp" / "weights" / entry.file) in entry.command
    assert entry.sha256 or entry.note, "what cannot be verified is said"


def test_what_was_asked_for_is_all_there():
    names = set(known_weights())
    assert {"grounding-dino-tiny", "grounding-dino-base", "sam-vit-base", "sam-vit-large", "sam-vit-huge"} <= names
    assert {"sam2.1-hiera-small", "sam3", "vlpart-swin-base", "clip-rn50"} <= names
    assert {"graspnet-realsense", "graspnet-kinect", "fgc-graspnet", "vgn"} <= names


@pytest.mark.parametrize(
    ("variable", "value", "cache"),
    [
        (None, None, ".cache/huggingface/hub"),
        ("XDG_CACHE_HOME", "xdg", "xdg/huggingface/hub"),
        ("HF_HOME", "hf", "hf/hub"),
        ("HF_HUB_CACHE", "c", "c"),
        ("HUGGINGFACE_HUB_CACHE", "old", "old"),
    ],
)
def test_the_hubs_cache_is_where_its_variables_say(here, monkeypatch, variable, value, cache):
    if variable:
        monkeypatch.setenv(variable, str(here / value))
    entry = known_weights()["sam-vit-base"]
    folder = put_in_cache(here / cache, "facebook/sam-vit-base", entry.revision)
    assert entry.find() == folder
    for source in ("sam-vit-base", "facebook/sam-vit-base", f"facebook/sam-vit-base@{entry.revision}"):
        assert locate_model(source, what="test") == folder


@pytest.mark.parametrize("names", [("config.json",), ("model.safetensors",), ("README.md",)])
def test_half_a_download_is_not_there(here, names):
    entry = known_weights()["sam-vit-base"]
    put_in_cache(weights.hub_cache(), "facebook/sam-vit-base", entry.revision, *names)
    assert entry.find() is None


def test_another_revision_is_not_the_pinned_one(here):
    put_in_cache(weights.hub_cache(), "facebook/sam-vit-base", COMMIT)
    with pytest.raises(ConfigError, match="get it with: hf download facebook/sam-vit-base --revision 70c1a07"):
        locate_model("facebook/sam-vit-base", what="test")
    assert locate_model(f"facebook/sam-vit-base@{COMMIT}", what="test").name == COMMIT


def test_an_unknown_model_without_a_commit_is_warned_about(here):
    folder = put_in_cache(weights.hub_cache(), "some/one", COMMIT)
    with (
        pytest.warns(UserWarning, match=r"some/one is not pinned to a commit.*some/one@COMMIT"),
        pytest.raises(ConfigError, match=r"looked for its main revision.*hf download some/one --include"),
    ):
        locate_model("some/one", what="test")
    (folder.parents[1] / "refs").mkdir()
    (folder.parents[1] / "refs" / "main").write_text(COMMIT)
    with pytest.warns(UserWarning, match="not pinned"):
        assert locate_model("some/one", what="test") == folder
    assert locate_model(f"some/one@{COMMIT}", what="test") == folder


def test_a_folder_goes_before_a_name(here, monkeypatch):
    folder = here / "sam-vit-base"
    folder.mkdir()
    (folder / "config.json").touch()
    monkeypatch.chdir(here)
    assert locate_model("sam-vit-base", what="test").resolve() == folder.resolve()
    assert locate_model("~/sam-vit-base", what="test") == folder
    assert locate_model(folder, what="test") == folder


def test_weights_by_name_in_a_folder_of_ones_own(here, monkeypatch):
    monkeypatch.setenv("THINKGRASP_WEIGHTS", str(here / "w"))
    assert known_weights()["vgn"].find() is None
    (here / "w" / "sam-vit-base").mkdir(parents=True)
    for name in ("vgn_conv.pth", "sam-vit-base/config.json", "sam-vit-base/model.safetensors"):
        (here / "w" / name).touch()
    assert known_weights()["vgn"].find() == here / "w" / "vgn_conv.pth"
    assert locate_model("sam-vit-base", what="test") == here / "w" / "sam-vit-base"


def test_the_doctor_lists_them_all(here, cli, monkeypatch):
    monkeypatch.setenv("THINKGRASP_WEIGHTS", str(here / "w"))
    (here / "w").mkdir()
    (here / "w" / "vgn_conv.pth").write_bytes(b"something else")
    (here / "w" / "checkpoint-rs.tar").touch()
    folder = put_in_cache(weights.hub_cache(), "facebook/sam-vit-base", known_weights()["sam-vit-base"].revision)
    result = cli("doctor", "--weights")
    assert result.code == 0
    for entry in known_weights().values():
        assert entry.name in result.out
        assert entry.licence in result.out
    assert f"here: {folder}" in result.out
    assert f"here: {here / 'w' / 'checkpoint-rs.tar'}" in result.out
    assert f"NOT THE KNOWN FILE (its SHA-256 differs): {here / 'w' / 'vgn_conv.pth'}" in result.out
    assert f"missing: {known_weights()['grounding-dino-tiny'].command}" in result.out
    assert "grounding-dino" not in cli("doctor").out
