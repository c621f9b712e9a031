"""A TorchScript archive's tensors, without running any of it."""

from __future__ import annotations

import pickle
import warnings
import zipfile

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from thinkgrasp.errors import ConfigError  # noqa: E402
from thinkgrasp.networks.torchscript_weights import is_torchscript, read_torchscript  # noqa: E402


class Net(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.Linear(2, 2).half())
        self.cut = torch.nn.Parameter(torch.randn(4, 5)[1:, 1:3])
        self.register_buffer("counts", torch.arange(3))
        self.sizes, self.name = [1, 2], "net"

    def forward(self, x):
        return self.layers[0](x)


@pytest.fixture
def archive(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        net = torch.jit.script(Net())
        torch.jit.save(net, tmp_path / "net.pt")
    return tmp_path / "net.pt", net.state_dict()


def rewrite(path, changed: dict[str, bytes | None]) -> None:
    """Replace entries of an archive by the end of their names; None = leave them out."""
    with zipfile.ZipFile(path) as old:
        entries = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w") as new:
        for name, data in entries.items():
            replaced = next((v for end, v in changed.items() if name.endswith(end)), data)
            if replaced is not None:
                new.writestr(name, replaced)


def test_every_tensor_is_read(archive):
    path, state = archive
    assert is_torchscript(path)
    found = read_torchscript(path, what="net")
    assert set(found) == set(state)
    for name, value in state.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value)


def test_other_files_are_none(tmp_path):
    torch.save({"w": torch.ones(1)}, tmp_path / "plain.pt")
    (tmp_path / "text").write_text("no archive")
    assert not is_torchscript(tmp_path / "plain.pt")
    assert not is_torchscript(tmp_path / "text")


class Harmful:
    def __reduce__(self):
        return (open, ("never", "w"))


def test_code_in_an_archive_is_not_run(archive, tmp_path, monkeypatch):
    path, _ = archive
    monkeypatch.chdir(tmp_path)
    rewrite(path, {"/data.pkl": pickle.dumps(Harmful())})
    with pytest.raises(ConfigError, match=r"net: .* names (io|_io)\.open, which is no part of a tensor"):
        read_torchscript(path, what="net")
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    "changed",
    [
        {"/data.pkl": None},
        {"/data.pkl": b""},
        {"/data.pkl": b"\x80\x02}q\x00X"},
        {"/data/0": b"123"},
        {"/data/0": None},
        {"/byteorder": b"big"},
    ],
)
def test_a_damaged_archive_is_named(archive, changed):
    path, _ = archive
    rewrite(path, changed)
    with pytest.raises(ConfigError, match=r"net: .*net\.pt"):
        read_torchscript(path, what="net")
