"""Weights are read without running code, and loaded whole or not at all."""

from __future__ import annotations

import pickle

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from thinkgrasp.errors import ConfigError  # noqa: E402
from thinkgrasp.networks.checkpoint import choose_device, load_strictly, read_checkpoint  # noqa: E402


def layer(out: int = 3) -> torch.nn.Linear:
    return torch.nn.Linear(2, out)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda w: w,
        lambda w: {"epoch": 3, "model_state_dict": w, "loss": 0.1},
        lambda w: {"model": w},
        lambda w: {"state_dict": {f"module.{k}": v for k, v in w.items()}},
    ],
)
def test_weights_are_found_however_they_were_saved(tmp_path, wrap):
    weights = layer().state_dict()
    torch.save(wrap(weights), tmp_path / "w.tar")
    found = read_checkpoint(tmp_path / "w.tar", what="test net")
    assert {k: v.tolist() for k, v in found.items()} == {k: v.tolist() for k, v in weights.items()}


def test_safetensors(tmp_path):
    st = pytest.importorskip("safetensors.torch", reason="needs thinkgrasp[langsam]")
    st.save_file(layer().state_dict(), tmp_path / "w.safetensors")
    assert set(read_checkpoint(tmp_path / "w.safetensors", what="test net")) == {"weight", "bias"}
    (tmp_path / "bad.safetensors").write_bytes(b"\x01" * 40)
    with pytest.raises(ConfigError, match="cannot be read as weights"):
        read_checkpoint(tmp_path / "bad.safetensors", what="test net")


class Harmful:
    def __reduce__(self):
        return (open, ("never", "w"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist"),
        (b"", "cannot be read as weights"),
        (b"not a checkpoint at all", "cannot be read as weights|not a plain file of weights"),
        (pickle.dumps(Harmful()), "could run code|cannot be read"),
    ],
)
def test_a_bad_file_is_named(tmp_path, content, message):
    path = tmp_path / "w.pth"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=message) as error:
        read_checkpoint(path, what="test net")
    assert str(path) in str(error.value)
    assert "test net" in str(error.value)


def test_code_in_a_file_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"model": {"w": torch.zeros(1)}, "more": Harmful()}, "w.pth")
    with pytest.raises(ConfigError, match="could run code"):
        read_checkpoint("w.pth", what="test net")
    assert not (tmp_path / "never").exists()


def test_a_folder_and_a_file_without_tensors(tmp_path):
    with pytest.raises(ConfigError, match="is a folder"):
        read_checkpoint(tmp_path, what="test net")
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(ConfigError, match="holds no named tensors"):
        read_checkpoint(tmp_path / "list.pth", what="test net")


def test_another_model_is_refused_and_nothing_is_loaded():
    net = layer()
    before = net.weight.clone()
    with pytest.raises(ConfigError) as error:
        load_strictly(net, {"weight": torch.ones(5, 2), "extra": torch.ones(1)}, what="test net")
    assert str(error.value) == (
        "test net: these are weights of another model: 1 of 2 tensors are missing (bias); 1 have another shape "
        "(weight is (5, 2) instead of (3, 2)); 1 are unknown (extra)"
    )
    assert torch.equal(net.weight, before)


def test_what_is_not_used_is_returned_and_optional_names_may_lack():
    net = layer()
    assert load_strictly(net, {"weight": torch.ones(3, 2), "x": torch.ones(1)}, what="t", optional={"bias"}) == ("x",)
    assert torch.equal(net.weight, torch.ones(3, 2))


def test_devices():
    assert choose_device("cpu", what="t").type == "cpu"
    assert choose_device(None, what="t").type in ("cpu", "cuda")
    for wrong in ("gpu", "cuda:99"):
        with pytest.raises(ConfigError, match="cannot be used here"):
            choose_device(wrong, what="t")
