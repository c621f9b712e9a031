"""The video of an episode as an animated WebP: every browser plays it, and Pillow is all it takes.

A static camera's picture changes little from frame to frame, so that each frame stores only the rectangle that changed.
Frames wait on disk, compressed, until the end: memory does not grow with the episode.
"""

from __future__ import annotations

import io
import struct
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageDraw, ImageFont

from thinkgrasp.errors import ContractError, InputError
from thinkgrasp.outputs import check_writable, write_atomic
from thinkgrasp.viz.glyphs import INK, PAPER, plain_text

MAX_FRAMES = 600
"""A longer episode keeps every second, fourth ... frame, and its length."""
QUALITY = 72
LAST_FRAME_MS = 2500
"""The last frame stays, so that the end can be read."""
STRIP_PX = 30
CHANGED = 10
"""Levels of a colour channel by which a pixel has to differ to be stored again."""
BLOCK_PX = 16
KEY_EVERY = 50
"""Every so many frames the whole picture is stored, which heals what the codec left behind."""

_NO_BLEND = 0b10
_IS_CHANGE = 3 * ((CHANGED + 1) * [0] + (255 - CHANGED) * [255])


class VideoWriter:
    """Collect frames and write the video when closed; nothing is written when the block ends by an error.

    Args:
        path: The .webp file to write; an existing one is replaced.
        size: Width and height of the frames [px].
        fps: Frames per second of the episode's time.

    Raises:
        InputError: The file cannot be written.
        ContractError: The size or the rate is not positive.
    """

    def __init__(self, path: str | Path, *, size: tuple[int, int], fps: float = 10.0) -> None:
        if min(size) < 1 or not fps > 0:
            raise ContractError(f"a video needs a positive size and rate, got {size} at {fps} frames per second")
        self._path = Path(path)
        check_writable(self._path, "the video")
        self._size = size
        self._frame_ms = 1000 / fps
        self._stride = 1
        self._added = 0
        self._spool = tempfile.TemporaryFile(prefix="thinkgrasp-video-")  # noqa: SIM115  (closed by close)
        self._kept: list[tuple[int, int]] = []
        self._caption = _Caption(size[0])

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        self._spool.close()

    def add(self, frame: NDArray[np.uint8], caption: str = "") -> None:
        """Add the next frame.

        Args:
            frame: RGB picture (H, W, 3) uint8 of the writer's size.
            caption: One line for the strip below; cut where it is too long.

        Raises:
            ContractError: The frame has another shape or type.
        """
        width, height = self._size
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise ContractError(f"a video frame must be ({height}, {width}, 3) uint8, got {frame.shape} {frame.dtype}")
        if self._added % self._stride == 0:
            sheet = Image.new("RGB", (width, height + STRIP_PX), INK)
            sheet.paste(Image.fromarray(frame), (0, 0))
            sheet.paste(self._caption.draw(caption), (0, height))
            start = self._spool.seek(0, io.SEEK_END)
            sheet.save(self._spool, "JPEG", quality=92, subsampling=0)
            self._kept.append((start, self._spool.tell() - start))
        self._added += 1
        if len(self._kept) > MAX_FRAMES:
            self._kept = self._kept[::2]
            self._stride *= 2

    def close(self) -> None:
        """Write the file; a video without frames is not written."""
        if self._spool.closed:
            return
        if self._kept:
            write_atomic(self._path, self._assemble())
        self._spool.close()

    def _assemble(self) -> bytes:
        """Put the frames into the container (RIFF with VP8X, ANIM and one ANMF per frame).

        References:
            WebP Container Specification, https://developers.google.com/speed/webp/docs/riff_container
        """
        frame_ms = round(self._frame_ms * self._stride)
        width, height = self._size[0], self._size[1] + STRIP_PX
        chunks = [
            _chunk(b"VP8X", bytes([0b10, 0, 0, 0]) + _u24(width - 1) + _u24(height - 1)),
            _chunk(b"ANIM", bytes(4) + struct.pack("<H", 0)),
        ]
        waiting: tuple[int, int, Image.Image] | None = None
        duration = 0
        shown: Image.Image | None = None
        for i, (start, length) in enumerate(self._kept):
            self._spool.seek(start)
            picture = Image.open(io.BytesIO(self._spool.read(length)))
            whole = (0, 0, width, height)
            box = whole if shown is None or i % KEY_EVERY == 0 else _changed(picture, shown)
            if box is not None:
                if waiting is not None:
                    chunks.append(_frame(*waiting, duration))
                part = picture.crop(box)
                waiting, duration = (box[0], box[1], part), 0
                shown = picture.copy() if shown is None else shown
                shown.paste(part, box)
            duration += frame_ms
        if waiting is not None:
            chunks.append(_frame(*waiting, duration + LAST_FRAME_MS))
        body = b"WEBP" + b"".join(chunks)
        return b"RIFF" + struct.pack("<I", len(body)) + body


class _Caption:
    """The strip below the picture; the last one is kept, as it rarely changes."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._font = ImageFont.load_default(size=15)
        self._last: tuple[str, Image.Image] | None = None

    def draw(self, caption: str) -> Image.Image:
        if self._last is None or self._last[0] != caption:
            strip = Image.new("RGB", (self._width, STRIP_PX), INK)
            words = plain_text(caption)
            while words and self._font.getlength(words) > self._width - 20:
                words = words[:-2].rstrip(" …") + "…" if len(words) > 2 else ""
            ImageDraw.Draw(strip).text((10, STRIP_PX / 2), words, PAPER, self._font, anchor="lm")
            self._last = caption, strip
        return self._last[1]


def _changed(a: Image.Image, b: Image.Image) -> tuple[int, int, int, int] | None:
    """The box (x0, y0, x1, y1) of what differs, in whole blocks of the codec; None = nothing."""
    box = ImageChops.difference(a, b).point(_IS_CHANGE).getbbox()
    if box is None:
        return None
    x0, y0 = (low // BLOCK_PX * BLOCK_PX for low in box[:2])
    x1, y1 = (min(-(-high // BLOCK_PX) * BLOCK_PX, size) for high, size in zip(box[2:], a.size, strict=True))
    return x0, y0, x1, y1


def _frame(x: int, y: int, image: Image.Image, duration_ms: int) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=QUALITY, method=2)
    picture = _picture_chunk(buffer.getvalue())
    head = (
        _u24(x // 2) + _u24(y // 2) + _u24(image.width - 1) + _u24(image.height - 1) + _u24(min(duration_ms, 2**24 - 1))
    )
    return _chunk(b"ANMF", head + bytes([_NO_BLEND]) + picture)


def _picture_chunk(file: bytes) -> bytes:
    """The chunk with the picture's bits, out of a still WebP file."""
    at = 12
    while at + 8 <= len(file):
        name, size = file[at : at + 4], struct.unpack_from("<I", file, at + 4)[0]
        if name in (b"VP8 ", b"VP8L"):
            return file[at : at + 8 + size + size % 2]
        at += 8 + size + size % 2
    raise InputError("Pillow wrote a WebP picture without a VP8 chunk; is its WebP support complete?")


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)


def _u24(value: int) -> bytes:
    return struct.pack("<I", value)[:3]
