"""A good frame as files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FrameFiles:
    """Paths of a good frame; tests replace one of them by something broken."""

    color: Path
    depth: Path
    camera: Path

    def args(self, instruction: str = "the red box") -> list[str]:
        return ["grasp", str(self.color), str(self.depth), instruction, "--camera", str(self.camera)]
