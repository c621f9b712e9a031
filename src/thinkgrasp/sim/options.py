"""Which camera looks at the simulated cell; loads nothing of the simulator."""

from __future__ import annotations

from dataclasses import dataclass

from thinkgrasp.errors import ConfigError


@dataclass(frozen=True)
class CameraOptions:
    """Sensor, image size and whether its noise is simulated."""

    model: str = "l515"
    size_wh: tuple[int, int] = (640, 480)
    noise: bool = True


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of "640x480".

    Raises:
        ConfigError: The text is no size.
    """
    width, cross, height = text.lower().partition("x")
    if cross and width.isdecimal() and height.isdecimal():
        return int(width), int(height)
    raise ConfigError(f"an image size is written WIDTHxHEIGHT, for example 640x480, got {text!r}")
