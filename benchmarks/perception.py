"""How well the proposals cover the things in rendered table-top scenes, scene kind by scene kind.

    python benchmarks/perception.py [--scenes 12] [--show DIR]

A thing counts when at least a quarter of it and 150 pixels are visible; it is found when a proposal overlaps it with
IoU >= 0.5. A proposal that overlaps no thing with IoU >= 0.3 is stray. Perception gets colour and depth only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from thinkgrasp.perception import GeometricPerception
from thinkgrasp.sim import tabletop as t
from thinkgrasp.sim.solids import Box, Paint
from thinkgrasp.types import CameraIntrinsics, Frame, Scene

COLORS = {
    "red": (186, 34, 36),
    "orange": (228, 120, 30),
    "yellow": (230, 200, 50),
    "green": (60, 150, 80),
    "blue": (40, 90, 190),
    "purple": (124, 60, 160),
    "white": (230, 230, 226),
    "black": (36, 36, 40),
    "grey": (128, 128, 130),
    "brown": (110, 72, 44),
}
TABLES = ((186, 160, 128), (88, 92, 96), (208, 206, 200), (70, 130, 128), (120, 84, 56))


@dataclass(frozen=True)
class Kind:
    """How scenes of one kind differ from the plain one."""

    objects: tuple[int, int] = (6, 10)
    spread_m: float = 0.24
    gap_m: float = 0.02
    dropout: float = 0.0
    with_pose: bool = False
    size: tuple[int, int] = (640, 480)
    eye_m: tuple[float, float] = (0.55, 0.9)
    """Distance range of the camera."""
    pitch_deg: tuple[float, float] = (35.0, 65.0)
    table_m: tuple[float, float] = (1.2, 0.8)
    desk: bool = False
    smear_px: int = 0
    """Width over which depth is averaged, edges included, as stereo cameras do; with waves of 1.2 % z^2."""


KINDS = {
    "apart": Kind(),
    "touching": Kind(objects=(8, 12), spread_m=0.14, gap_m=-0.002),
    "depth-missing": Kind(dropout=0.2),
    "with-pose": Kind(with_pose=True),
    "small-table": Kind(table_m=(0.55, 0.5), eye_m=(0.9, 1.2), pitch_deg=(30, 45), desk=True),
    "wide-image": Kind(size=(1280, 720)),
    "from-above": Kind(pitch_deg=(75, 88)),
}

SMEARED = {"touching-smear": replace(KINDS["touching"], smear_px=7)}
"""Kept apart from KINDS, which other benchmarks draw from."""


def smeared(frame: Frame, width_px: int, rng: np.random.Generator) -> Frame:
    """Average depth over a window, whatever edge runs through it, and add slow waves."""
    seen = frame.depth > 0
    share = ndimage.uniform_filter(seen.astype(np.float32), width_px)
    mean = ndimage.uniform_filter(np.where(seen, frame.depth, 0), width_px) / np.maximum(share, 1e-3)
    waves = ndimage.gaussian_filter(rng.normal(0.0, 1.0, seen.shape), 4) * 0.012 * frame.depth**2
    return replace(frame, depth=np.where(seen, mean + waves, 0).astype(np.float32))


def random_object(rng: np.random.Generator, x: float, y: float, z: float = 0.0) -> tuple[t.TableObject, float]:
    """Return a random household-like thing and the radius of its footprint [m]."""
    color, other = rng.choice(list(COLORS), 2, replace=False)
    T = t.pose(x, y, z, rng.uniform(0, 2 * np.pi))
    label = Paint(COLORS[color], COLORS[other], (-0.01, 0.03))
    plain = Paint(COLORS[color])
    kind = rng.choice(["box", "can", "mug", "cup", "bowl", "ball", "banana", "marker", "drill", "lying", "block"])
    if kind == "box":
        size = (rng.uniform(0.07, 0.17), rng.uniform(0.03, 0.07), rng.uniform(0.08, 0.21))
        return t.box(f"{color} box", size, label, T), float(np.hypot(*size[:2])) / 2
    if kind == "block":
        size = tuple(rng.uniform(0.025, 0.07, 3))
        return t.box(f"{color} block", size, plain, T), float(np.hypot(*size[:2])) / 2
    if kind == "can":
        r = rng.uniform(0.022, 0.04)
        return t.can(f"{color} can", r, rng.uniform(0.05, 0.14), label, T), r
    if kind == "mug":
        r = rng.uniform(0.035, 0.045)
        return t.mug(f"{color} mug", r, rng.uniform(0.08, 0.11), plain, T), r + 0.03
    if kind == "cup":
        r = rng.uniform(0.025, 0.04)
        return t.cup(f"{color} cup", r, rng.uniform(0.06, 0.11), plain, T), 1.2 * r
    if kind == "bowl":
        return t.bowl(f"{color} bowl", rng.uniform(0.07, 0.09), 0.055, plain, T), 0.08
    if kind == "ball":
        r = rng.uniform(0.02, 0.04)
        return t.ball(f"{color} ball", r, plain, T), r
    if kind == "banana":
        return t.banana("banana", T), 0.09
    if kind == "marker":
        return t.marker(f"{color} marker", plain, T), 0.062
    if kind == "drill":
        return t.drill("drill", T), 0.1
    r = rng.uniform(0.02, 0.035)
    body = replace(t.can("lying bottle", r, rng.uniform(0.11, 0.19), label, T))
    down = np.eye(4)
    down[:3, :3] = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    down[:3, 3] = [-0.07, 0, r]
    return replace(body, name=f"{color} bottle", T_world_object=T @ down), 0.09


def random_scene(
    kind: Kind, rng: np.random.Generator, make: Callable[..., tuple[t.TableObject, float]] = random_object
) -> t.TabletopScene:
    """Place things next to one another until the number is reached or no room is left."""
    placed: list[tuple[float, float, float]] = []
    objects: list[t.TableObject] = []
    wanted = int(rng.integers(kind.objects[0], kind.objects[1] + 1))
    for _ in range(400):
        x, y = rng.uniform(-kind.spread_m, kind.spread_m, 2) * [1.0, 0.8]
        thing, radius = make(rng, x, y)
        if all(np.hypot(x - a, y - b) > radius + r + kind.gap_m for a, b, r in placed):
            placed.append((x, y, radius))
            objects.append(thing)
            if len(objects) == wanted:
                break
    background: tuple[t.TableObject, ...] = ()
    if kind.desk:
        slab = Box((1.2, 0.6, 0.04), Paint((110, 90, 70)), t.pose(0.5, 1.1, -0.15))
        chair = Box((0.4, 0.4, 0.4), Paint((40, 110, 120)), t.pose(-0.8, 0.6, -0.4))
        background = (t.TableObject("desk", (slab,), np.eye(4)), t.TableObject("chair", (chair,), np.eye(4)))
    table = TABLES[int(rng.integers(len(TABLES)))]
    return t.TabletopScene(tuple(objects), table_size_m=kind.table_m, table_color=table, background=background)


def random_view(kind: Kind, rng: np.random.Generator) -> tuple[CameraIntrinsics, NDArray[np.float64]]:
    """Return intrinsics and T_world_camera of a camera that looks at the middle of the table."""
    w, h = kind.size
    f = 0.95 * w * (0.75 if w > 640 else 1.0)
    pitch, turn = np.radians(rng.uniform(*kind.pitch_deg)), rng.uniform(-0.5, 0.5)
    d = rng.uniform(*kind.eye_m)
    eye = (d * np.cos(pitch) * np.sin(turn), -d * np.cos(pitch) * np.cos(turn), d * np.sin(pitch))
    return CameraIntrinsics(w, h, f, f, (w - 1) / 2, (h - 1) / 2), t.look_at(eye, (0.0, 0.0, 0.03))


def overlaps(scene: Scene, rendering: t.Rendering) -> NDArray[np.float64]:
    """Return IoU (objects, proposals)."""
    masks = [p.mask for p in scene.proposals]
    out = np.zeros((len(rendering.visible_fraction), len(masks)))
    for i in range(len(out)):
        truth = rendering.mask(i)
        for j, mask in enumerate(masks):
            out[i, j] = (truth & mask).sum() / max((truth | mask).sum(), 1)
    return out


def picture(scene: Scene, rendering: t.Rendering) -> Image.Image:
    """Draw proposals in colour over the frame."""
    image = rendering.frame.color.astype(float)
    rng = np.random.default_rng(1)
    for p in scene.proposals:
        image[p.mask] = 0.5 * image[p.mask] + 0.5 * rng.integers(0, 255, 3)
    drawn = Image.fromarray(image.astype(np.uint8))
    pen = ImageDraw.Draw(drawn)
    for p in scene.proposals:
        pen.rectangle(p.box_xyxy, outline=(255, 0, 255))
        pen.text(p.box_xyxy[:2], str(p.mark), fill=(255, 255, 255))
    return drawn


def main(scenes: int = 12, show: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None) -> None:
    """Print one line per kind: things, found, mean IoU of the found, stray proposals per scene, support right."""
    perception = GeometricPerception()
    print(f"{'kind':15s} things  found   IoU  stray/scene  support")
    for name, kind in {**KINDS, **SMEARED}.items():
        total = found = stray = support = 0
        ious: list[float] = []
        for seed in range(scenes):
            rng = np.random.default_rng(1000 + seed)
            layout = random_scene(kind, rng)
            camera, T = random_view(kind, rng)
            rendering = t.render(layout, camera, T, rng=rng, dropout=kind.dropout)
            frame = rendering.frame if kind.with_pose else replace(rendering.frame, T_world_camera=None)
            if kind.smear_px:
                frame = smeared(frame, kind.smear_px, rng)
            scene = perception.perceive(frame)
            normal = T[:3, 2]
            if scene.support is not None:
                normal = T[:3, :3] @ scene.support.normal
                support += bool(
                    normal[2] > 0.995 and abs(scene.support.height(np.array(T[:3, :3].T @ -T[:3, 3]))) < 0.01
                )
            iou = overlaps(scene, rendering)
            counted = [
                i for i, f in enumerate(rendering.visible_fraction) if f >= 0.25 and rendering.mask(i).sum() >= 150
            ]
            best = iou[counted].max(axis=1, initial=0.0)
            total += len(counted)
            found += int((best >= 0.5).sum())
            ious.extend(best[best >= 0.5])
            stray += int((iou.max(axis=0, initial=0.0) < 0.3).sum())
            if show:
                show.mkdir(parents=True, exist_ok=True)
                picture(scene, rendering).save(show / f"{name}-{seed}.png")
        quality = f"{found / total:5.2f}  {np.mean(ious):4.2f}  {stray / scenes:11.1f}"
        print(f"{name:15s} {total:6d}  {quality}  {support}/{scenes}")


if __name__ == "__main__":
    tyro.cli(main)
