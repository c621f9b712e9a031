"""Output files are refused early, written whole, and never half."""

from __future__ import annotations

import os
import stat

import pytest

from thinkgrasp.errors import InputError
from thinkgrasp.outputs import check_writable, make_folder, one_line, write_atomic


class TestCheckWritable:
    def test_good_paths_pass_and_leave_nothing(self, tmp_path):
        check_writable(tmp_path / "new.png", "--overlay")
        (tmp_path / "old.png").write_bytes(b"x")
        check_writable(tmp_path / "old.png", "--overlay")
        assert [p.name for p in tmp_path.iterdir()] == ["old.png"]

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("missing/out.png", "directory .* does not exist"),
            ("folder", "is a directory"),
            ("file/out.png", "does not exist"),
            ("a\0b", "cannot be written"),
            ("x" * 300, "cannot be written"),
        ],
    )
    def test_bad_paths(self, tmp_path, name, message):
        (tmp_path / "folder").mkdir()
        (tmp_path / "file").write_bytes(b"x")
        with pytest.raises(InputError, match=message):
            check_writable(tmp_path / name, "--overlay")

    def test_inputs_are_not_overwritten(self, tmp_path):
        (tmp_path / "color.png").write_bytes(b"x")
        (tmp_path / "link.png").symlink_to(tmp_path / "color.png")
        for name in ("color.png", "link.png"):
            with pytest.raises(InputError, match="would overwrite an input file"):
                check_writable(tmp_path / name, "--overlay", inputs=[tmp_path / "color.png"])

    @pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder in which nobody can write: /proc")
    def test_a_folder_where_nothing_can_be_written(self):
        from pathlib import Path

        with pytest.raises(InputError, match="cannot be written"):
            check_writable(Path("/proc/self/out.png"), "--view")
        with pytest.raises(InputError, match="cannot be used"):
            make_folder(Path("/proc/self/out"))


class TestWriteAtomic:
    def test_content_and_mode(self, tmp_path):
        path = tmp_path / "out.bin"
        write_atomic(path, b"one")
        write_atomic(path, b"two")
        assert path.read_bytes() == b"two"
        umask = os.umask(0)
        os.umask(umask)
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask
        assert [p.name for p in tmp_path.iterdir()] == ["out.bin"]

    def test_a_failed_write_leaves_the_old_file_and_no_debris(self, tmp_path, monkeypatch):
        path = tmp_path / "out.bin"
        write_atomic(path, b"old")

        def fail(*_):
            raise OSError("disk full")

        monkeypatch.setattr(os, "replace", fail)
        with pytest.raises(InputError, match="disk full"):
            write_atomic(path, b"new")
        assert path.read_bytes() == b"old"
        assert [p.name for p in tmp_path.iterdir()] == ["out.bin"]


def test_make_folder(tmp_path):
    make_folder(tmp_path / "a" / "b")
    assert list((tmp_path / "a" / "b").iterdir()) == []
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(InputError, match="cannot be used"):
        make_folder(tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "line"),
    [("a\nb\r\n\tc", "a b c"), ("\x1b[31mred\x1b[0m", "[31mred [0m"), ("  x  ", "x"), ("", ""), ("ä 1", "ä 1")],
)
def test_one_line(text, line):
    assert one_line(text) == line


def test_one_line_is_bounded():
    assert len(one_line("x" * 10_000)) == 600
