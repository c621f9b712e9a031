"""The animated WebP: frames, times, sizes, what is kept of a long episode."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from thinkgrasp.errors import ContractError, InputError
from thinkgrasp.viz import video
from thinkgrasp.viz.video import LAST_FRAME_MS, STRIP_PX, VideoWriter

SIZE = (96, 64)


def frame(i: int) -> np.ndarray:
    """A grey gradient with a red square that moves to the right by three pixels a frame."""
    picture = np.repeat(np.linspace(60, 180, SIZE[0]).astype(np.uint8)[None, :, None], SIZE[1], axis=0)
    picture = np.repeat(picture, 3, axis=2)
    x = 3 * i % (SIZE[0] - 16)
    picture[20:36, x : x + 16] = (220, 30, 30)
    return picture


def read(path: Path) -> list[tuple[np.ndarray, int]]:
    """Frames (H, W, 3) with their durations [ms]."""
    frames = []
    with Image.open(path) as image:
        assert image.format == "WEBP"
        for i in range(getattr(image, "n_frames", 1)):
            image.seek(i)
            image.load()
            frames.append((np.asarray(image.convert("RGB")).astype(int), int(image.info["duration"])))
    return frames


def test_every_frame_is_shown_for_its_time(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.webp", size=SIZE, fps=20) as writer:
        for i in range(12):
            writer.add(frame(i), f"Step {i}")
    found = read(tmp_path / "a.webp")
    assert len(found) == 12
    assert [ms for _, ms in found] == [50] * 11 + [50 + LAST_FRAME_MS]
    for i, (picture, _) in enumerate(found):
        assert picture.shape == (SIZE[1] + STRIP_PX, SIZE[0], 3)
        assert np.abs(picture[: SIZE[1]] - frame(i)).mean() < 6, i


def test_still_moments_are_stored_once(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.webp", size=SIZE) as writer:
        for i in (0, 0, 0, 1, 1, 2):
            writer.add(frame(i))
    assert [ms for _, ms in read(tmp_path / "a.webp")] == [300, 200, 100 + LAST_FRAME_MS]


def test_long_episodes_are_thinned_and_keep_their_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MAX_FRAMES", 10)
    with VideoWriter(tmp_path / "a.webp", size=SIZE, fps=10) as writer:
        for i in range(50):
            writer.add(frame(i % 20))
    found = read(tmp_path / "a.webp")
    assert len(found) <= 10
    assert sum(ms for _, ms in found) - LAST_FRAME_MS == pytest.approx(5000, abs=800)


def test_caption_is_drawn_and_cut_to_the_width(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.webp", size=SIZE) as writer:
        writer.add(frame(0))
        writer.add(frame(0), "Step 3: clear the way \n" * 20)
        writer.add(frame(0), "\x00")
    empty, long, nothing = (picture[SIZE[1] :] for picture, _ in read(tmp_path / "a.webp"))
    assert (long.max(axis=2) > 150).mean() > 0.03
    assert (long[:, -8:].max(axis=2) > 150).mean() == 0
    assert max((strip.max(axis=2) > 150).mean() for strip in (empty, nothing)) == 0


def test_memory_does_not_grow_with_the_episode(tmp_path: Path) -> None:
    import tracemalloc

    with VideoWriter(tmp_path / "a.webp", size=(320, 240)) as writer:
        rng = np.random.default_rng(0)
        noisy = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
        writer.add(noisy)
        tracemalloc.start()
        for _ in range(60):
            writer.add(noisy)
        grown, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert grown < noisy.nbytes


def test_same_frames_same_file(tmp_path: Path) -> None:
    for name in ("a.webp", "b.webp"):
        with VideoWriter(tmp_path / name, size=SIZE) as writer:
            for i in range(5):
                writer.add(frame(i), "Step 1")
    assert (tmp_path / "a.webp").read_bytes() == (tmp_path / "b.webp").read_bytes()


def test_nothing_is_written_after_an_error_or_without_frames(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.webp", size=SIZE):
        pass
    with pytest.raises(ContractError), VideoWriter(tmp_path / "b.webp", size=SIZE) as writer:
        [writer.add(picture) for picture in (frame(0), frame(0)[1:])]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "bad", [np.zeros((64, 96), np.uint8), np.zeros((96, 64, 3), np.uint8), np.zeros((64, 96, 3), np.float32)]
)
def test_frames_of_another_kind_are_refused(tmp_path: Path, bad: np.ndarray) -> None:
    with (
        VideoWriter(tmp_path / "a.webp", size=SIZE) as writer,
        pytest.raises(ContractError, match=r"must be \(64, 96, 3\) uint8, got"),
    ):
        writer.add(bad)


def test_bad_places_and_rates_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the video .*nowhere.* does not exist"):
        VideoWriter(tmp_path / "nowhere" / "a.webp", size=SIZE)
    with pytest.raises(ContractError, match="positive size and rate"):
        VideoWriter(tmp_path / "a.webp", size=SIZE, fps=0)
