"""What was computed from an image, kept for the next question about the same image."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from hashlib import blake2b
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


class ImageCache(Generic[T]):
    """Results of the last few images, known by what the pixels are and not by where they lie in memory.

    Args:
        size: So many images are kept; 0 keeps none.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._kept: OrderedDict[tuple[bytes, tuple[int, ...]], T] = OrderedDict()

    def get(self, image: NDArray[np.uint8], make: Callable[[], T]) -> T:
        """Return the result for an image (H, W, 3), made where it is not kept."""
        key = blake2b(np.ascontiguousarray(image).data, digest_size=16).digest(), image.shape
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        result = make()
        self._kept[key] = result
        while len(self._kept) > self.size:
            self._kept.popitem(last=False)
        return result
