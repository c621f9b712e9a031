"""From a frame's colours to what a network takes: resized, scaled, normalised and padded, with PIL and numpy alone.

The numbers are those of the library's own processors that use PIL. Those that use torchvision resize with it, and
differ by at most 2 of 255 grey levels, by less than 0.1 on average (tests/segmenters/test_image_input.py).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thinkgrasp.errors import ConfigError
from thinkgrasp.types import Array

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class NetworkImage:
    """An image as a network takes it."""

    pixels: Array
    """(3, h, w), padded."""
    size_hw: tuple[int, int]
    """Rows and columns that are image; the rest is padding, below and to the right."""
    original_hw: tuple[int, int]


@dataclass(frozen=True)
class ImageInput:
    """How a network wants its images; `read` takes it from the model's folder."""

    size: Mapping[str, int]
    """{height, width}: exactly so; {longest_edge}: that long, in proportion; {shortest_edge, longest_edge}: as short
    as that, in proportion, unless it gets longer than the other."""
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    scale: float = 1 / 255
    resample: int = 2
    """As PIL numbers them; 2 = bilinear."""
    pad_hw: tuple[int, int] | None = None

    def read(self, folder: Path, *, what: str) -> ImageInput:
        """Return these settings with what preprocessor_config.json, or processor_config.json, says otherwise.

        Raises:
            ConfigError: That file cannot be read, or holds something else.
        """
        settings = _settings(folder, what)
        size, pad = settings.get("size", self.size), settings.get("pad_size")
        try:
            size = {str(key): int(value) for key, value in size.items() if value}
            mean, std = (tuple(float(v) for v in settings.get(f"image_{k}", getattr(self, k))) for k in ("mean", "std"))
            found = ImageInput(
                size,
                cast(tuple[float, float, float], mean),
                cast(tuple[float, float, float], std),
                float(settings.get("rescale_factor", self.scale)),
                int(settings.get("resample", self.resample)),
                self.pad_hw and ((int(pad["height"]), int(pad["width"])) if pad else self.pad_hw),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{what}: the image settings in {folder} cannot be used: {error}") from None
        known = ({"height", "width"}, {"longest_edge"}, {"shortest_edge", "longest_edge"})
        if set(found.size) not in known or len(found.mean) != 3 or len(found.std) != 3:
            raise ConfigError(f"{what}: the image settings in {folder} cannot be used: size {dict(found.size)}")
        return found

    def resized_hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Return the size that an image of that size gets, without padding."""
        h, w = hw
        if "height" in self.size:
            return self.size["height"], self.size["width"]
        longest = self.size["longest_edge"]
        if "shortest_edge" not in self.size:
            factor = longest / max(h, w)
            return int(h * factor + 0.5), int(w * factor + 0.5)
        shortest: float = self.size["shortest_edge"]
        if max(h, w) / min(h, w) * shortest > longest:
            shortest = longest * min(h, w) / max(h, w)
        side = round(shortest)
        if min(h, w) == side:
            return h, w
        return (int(shortest * h / w), side) if w < h else (side, int(shortest * w / h))

    def __call__(self, image: NDArray[np.uint8]) -> NetworkImage:
        """Return an RGB image (H, W, 3) as the network takes it."""
        h, w = self.resized_hw((image.shape[0], image.shape[1]))
        resized = Image.fromarray(np.ascontiguousarray(image)).resize((w, h), Image.Resampling(self.resample))
        scaled = (np.asarray(resized).astype(np.float64) * self.scale).astype(np.float32)
        normal = (scaled - np.array(self.mean, np.float32)) / np.array(self.std, np.float32)
        full_h, full_w = self.pad_hw or (h, w)
        pixels = np.zeros((3, full_h, full_w), np.float32)
        pixels[:, :h, :w] = normal.transpose(2, 0, 1)
        return NetworkImage(pixels, (h, w), (image.shape[0], image.shape[1]))


def _settings(folder: Path, what: str) -> dict[str, Any]:
    for name in ("preprocessor_config.json", "processor_config.json"):
        path = folder / name
        if not path.is_file():
            continue
        try:
            content: object = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{what}: {path} cannot be read: {error}") from None
        if isinstance(content, dict):
            settings = cast(dict[str, Any], content)
            return cast(dict[str, Any], settings.get("image_processor", settings))
    return {}
