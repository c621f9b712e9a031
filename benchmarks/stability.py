"""How much the proposals on real frames depend on patch size and random seed.

    python benchmarks/stability.py DIR

DIR as for benchmarks/real_frames.py. Prints, per frame, the mean over the annotated boxes of the best IoU of a
proposal's box: its mean, lowest and highest over patch sizes 9 to 12 and three seeds.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import tyro
from real_frames import iou, load_scene

from thinkgrasp.perception import GeometricPerception


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Print one line per frame."""
    data = json.loads((folder / "annotations.json").read_text())
    for name, scene in data["scenes"].items():
        frame = load_scene(folder, name, data["camera"], Path(tempfile.mkdtemp()))
        means: list[float] = []
        for patch_px in (9, 10, 11, 12):
            for seed in range(3):
                proposals = GeometricPerception(patch_px=patch_px, seed=seed).perceive(frame).proposals
                best = [
                    max(iou(p.box_xyxy, tuple(box)) for p in proposals for box in entry["target_xyxy"])
                    for entry in scene["instructions"]
                ]
                means.append(float(np.mean(best)))
        print(f"{name:10s} mean best IoU {np.mean(means):.2f}   lowest {min(means):.2f}   highest {max(means):.2f}")


if __name__ == "__main__":
    tyro.cli(main)
