"""Target and grasp against named boxes on real frames.

    python benchmarks/real_frames.py DIR [--instructions FILE] [--show DIR]

DIR holds `annotations.json` (camera, scenes: instructions with the boxes that answer to them) and, per scene,
`NAME-color.png` and `NAME-depth.png`, optionally `NAME-meta.mat` (intrinsics) and `NAME-workspace_mask.png`. Another
instruction file of the same form can be given. Right means: the target's box has IoU >= 0.5 with a named box, and the
grasp's TCP projects into that box.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from thinkgrasp import Decision, Frame, load_frame, make_pipeline
from thinkgrasp.viz.overlay import draw_overlay


def iou(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the IoU of two half-open boxes."""
    w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(w, 0) * max(h, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def load_scene(folder: Path, name: str, camera: dict[str, float], out: Path) -> Frame:
    """Load one frame of the folder."""
    meta, mask = folder / f"{name}-meta.mat", folder / f"{name}-workspace_mask.png"
    if not meta.is_file():
        meta = out / "camera.json"
        meta.write_text(json.dumps(camera))
    return load_frame(
        folder / f"{name}-color.png",
        folder / f"{name}-depth.png",
        meta,
        workspace_mask=mask if mask.is_file() else None,
    )


def judge(decision: Decision, boxes: list[list[float]]) -> tuple[bool, bool, float]:
    """Return whether the target's box is right, whether the TCP projects into the right box, and the best IoU."""
    if decision.target is None:
        return False, False, 0.0
    scores = [iou(decision.target.box_xyxy, tuple(b)) for b in boxes]
    best = int(np.argmax(scores))
    inside = False
    if decision.grasp is not None:
        u, v = decision.scene.frame.camera.project(decision.grasp.position)
        x0, y0, x1, y1 = boxes[best]
        inside = bool(x0 <= u < x1 and y0 <= v < y1)
    return scores[best] >= 0.5, inside and scores[best] >= 0.5, scores[best]


def main(
    folder: tyro.conf.Positional[Path],
    instructions: Path | None = None,
    show: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    preset: str = "offline",
) -> None:
    """Print one line per instruction, and the totals."""
    data = json.loads((folder / "annotations.json").read_text())
    scenes = json.loads(instructions.read_text())["scenes"] if instructions else data["scenes"]
    pipeline = make_pipeline(preset)
    out = show or Path(tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    right = target_right = total = 0
    for name, scene in scenes.items():
        frame = load_scene(folder, name, data["camera"], out)
        for entry in scene["instructions"]:
            decision = pipeline.decide(frame, entry["instruction"])
            on_target, on_grasp, overlap = judge(decision, entry["target_xyxy"])
            total += 1
            target_right += on_target
            right += on_grasp
            times = dict(decision.timings_ms)
            print(
                f"{'ok ' if on_grasp else 'BAD'} {name:9s} {entry['instruction']:34s} {decision.status:9s} "
                f"{decision.plan.role:11s} {decision.plan.target[:24]:24s} IoU {overlap:4.2f} "
                f"{'tcp in' if on_grasp else 'tcp out'}  {times['total']:5.0f} ms"
            )
            if show:
                label = entry["instruction"].replace(" ", "_")
                draw_overlay(decision, pipeline.gripper).save(show / f"{name}-{label}.png")
    print(f"target box right {target_right}/{total}, target and grasp right {right}/{total}")


if __name__ == "__main__":
    tyro.cli(main)
