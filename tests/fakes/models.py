"""Small networks with random weights, saved once per process and loaded as any model is."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

SIZES_WH = ((224, 224), (640, 480), (1280, 720))

_FOLDER = tempfile.TemporaryDirectory(prefix="random-models-")


@cache
def model(kind: str) -> Path:
    """The folder of a small "grounding_dino", "sam", "sam2" or "sam3"."""
    from thinkgrasp.testing import random_models

    folder = Path(_FOLDER.name) / kind
    folder.mkdir()
    return getattr(random_models, f"save_{kind}")(folder)


@cache
def picture(width: int, height: int, seed: int = 0) -> NDArray[np.uint8]:
    """Coloured blobs with grain: (H, W, 3)."""
    rng = np.random.default_rng(seed)
    coarse = ndimage.zoom(rng.uniform(0, 255, (6, 8, 3)), (height / 6, width / 8, 1), order=1)
    grain = rng.normal(0, 12, (height, width, 3))
    image = np.clip(coarse[:height, :width] + grain, 0, 255).astype(np.uint8)
    image.setflags(write=False)
    return image
