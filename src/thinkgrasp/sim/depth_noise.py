"""What depth cameras add to the true depth: noise, holes and mixed pixels. Pure numpy, seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.types import Array


@dataclass(frozen=True)
class DepthNoise:
    """A sensor model; every stage is off at 0.

    Noise is Gaussian with standard deviation sigma_m[0] + sigma_m[1] z + sigma_m[2] z^2 at depth z, divided by the
    cosine between the surface normal and the ray (at most `grazing_gain` times as much).

    Raises:
        ConfigError: A length, share or factor is negative, or ranges are not ordered.
    """

    sigma_m: tuple[float, float, float]
    """Constant [m], linear [m/m] and quadratic [m/m^2] part."""
    correlation_px: float
    """Standard deviation of the Gaussian that smooths the noise at 640x480; 0 = every pixel on its own."""
    grazing_gain: float
    grazing_cosine: tuple[float, float]
    """No return below the first, always one above the second, with a chance in between."""
    edge_jump_m: float
    """Neighbours that miss a straight line by more than this are on an edge."""
    edge_dropout: float
    """Share of edge pixels without return."""
    edge_jitter: float
    """Share of edge pixels that show a neighbour's depth."""
    edge_flying: float
    """Share of edge pixels that lie somewhere between themselves and a neighbour."""
    resolution_m: float
    range_m: tuple[float, float]
    """Nothing returns from nearer or farther."""

    def __post_init__(self) -> None:
        shares = (self.edge_dropout, self.edge_jitter, self.edge_flying)
        lengths = (*self.sigma_m, self.correlation_px, self.edge_jump_m, self.resolution_m)
        if min(shares) < 0 or sum(shares) > 1:
            raise ConfigError(f"depth noise: the shares of edge pixels must be >= 0 with a sum up to 1, got {shares}")
        if min(lengths) < 0 or self.grazing_gain < 1:
            raise ConfigError("depth noise: lengths must be >= 0 and grazing_gain >= 1")
        for name in ("grazing_cosine", "range_m"):
            low, high = getattr(self, name)
            if not 0 <= low < high:
                raise ConfigError(f"depth noise: {name} must be two rising values >= 0, got {low}, {high}")

    def apply(self, depth: Array, cosine: Array, rng: np.random.Generator) -> Array:
        """Return what the sensor reports.

        Args:
            depth: (H, W) float32 true depth [m]; 0 = no surface.
            cosine: (H, W) cosine between the surface normal and the ray, 0..1.
            rng: Source of all randomness.

        Returns:
            (H, W) float32 [m]; 0 = no return.

        Raises:
            InputError: The arrays differ in shape.
        """
        if depth.shape != cosine.shape or depth.ndim != 2:
            raise InputError(f"depth and cosine must be images of one size, got {depth.shape} and {cosine.shape}")
        lost = rng.random(depth.shape, dtype=np.float32) > _ramp(cosine, *self.grazing_cosine)
        measured = self._at_edges(depth, rng)
        lost |= (measured < self.range_m[0]) | (measured > self.range_m[1])

        grain = rng.standard_normal(depth.shape, dtype=np.float32)
        width = self.correlation_px * depth.shape[0] / 480
        if width > 0:
            grain = ndimage.gaussian_filter(grain, width, mode="reflect")
            grain *= _gain_of_smoothing(width)
        a, b, c = (np.float32(s) for s in self.sigma_m)
        sigma = (a + measured * (b + c * measured)) / np.maximum(cosine, np.float32(1 / self.grazing_gain))
        measured = measured + sigma * grain
        if self.resolution_m > 0:
            step = np.float32(self.resolution_m)
            measured = np.round(measured / step) * step
        return np.where(lost, np.float32(0), measured)

    def _at_edges(self, depth: Array, rng: np.random.Generator) -> Array:
        """Depth with pixels on edges lost, moved or mixed."""
        padded = np.pad(depth, 1, mode="edge")
        left, right, above, below = padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]
        bend = np.maximum(np.abs(left + right - 2 * depth), np.abs(above + below - 2 * depth))
        at = np.nonzero((depth > 0) & (bend > np.float32(self.edge_jump_m)))
        side, chance, share = rng.integers(4, size=len(at[0])), rng.random(len(at[0])), rng.random(len(at[0]))
        own = depth[at]
        other = np.choose(side, [left[at], right[at], above[at], below[at]])
        mixed = (own + share * (other - own)).astype(np.float32)
        mixed[other == 0] = 0
        bounds = np.cumsum([self.edge_dropout, self.edge_jitter, self.edge_flying])
        out = depth.copy()
        out[at] = np.select([chance < bounds[0], chance < bounds[1], chance < bounds[2]], [0 * own, other, mixed], own)
        return out


def _ramp(x: Array, low: float, high: float) -> Array:
    return np.clip((x - np.float32(low)) / np.float32(high - low), 0, 1)


def _gain_of_smoothing(width_px: float) -> np.float32:
    """What white noise must be multiplied by after a Gaussian filter to have unit variance again."""
    radius = int(4 * width_px + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / width_px) ** 2)
    kernel /= kernel.sum()
    return np.float32(1 / (kernel**2).sum())


NOISE_MODELS = {
    "l515": DepthNoise(
        sigma_m=(0.0004, 0.0010, 0.0),
        correlation_px=0.6,
        grazing_gain=4.0,
        grazing_cosine=(0.05, 0.20),
        edge_jump_m=0.012,
        edge_dropout=0.30,
        edge_jitter=0.20,
        edge_flying=0.06,
        resolution_m=0.00025,
        range_m=(0.25, 9.0),
    ),
    "d455": DepthNoise(
        sigma_m=(0.0, 0.0, 0.0055),
        correlation_px=2.0,
        grazing_gain=3.0,
        grazing_cosine=(0.08, 0.28),
        edge_jump_m=0.015,
        edge_dropout=0.40,
        edge_jitter=0.30,
        edge_flying=0.10,
        resolution_m=0.001,
        range_m=(0.30, 6.0),
    ),
}
"""Sensor models by name.

L515, a scanned time-of-flight sensor: 1 mm at 0.6 m, growing with distance, nearly independent pixels; depth unit
0.25 mm, range 0.25 to 9 m. D455, active stereo: an error in disparity is an error in depth that grows with its square;
2 mm at 0.6 m is 2 % at 4 m, the accuracy that is published for it, scaled; depth unit 1 mm. What happens at edges and
grazing angles is chosen, not measured.
"""


def noise_model(name: str | None) -> DepthNoise | None:
    """Return a sensor model by name; None stays None: exact depth.

    Raises:
        ConfigError: No such model.
    """
    if name is None:
        return None
    if name not in NOISE_MODELS:
        raise ConfigError(f"no depth noise {name!r}; allowed are {', '.join(NOISE_MODELS)}, or None for exact depth")
    return NOISE_MODELS[name]
