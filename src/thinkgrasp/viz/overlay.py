"""One picture that says what was decided: marks, the target with its grid and cell, the gripper, the reason."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from thinkgrasp.gripper import Gripper
from thinkgrasp.selection import cell_box
from thinkgrasp.types import BoxXYXY, CameraIntrinsics, Decision, Grasp, Mask, Proposal
from thinkgrasp.viz.glyphs import (
    BOX_FACES,
    GRIPPER,
    INK,
    MUTED,
    PAPER,
    POINT,
    RGB,
    STATUS,
    STATUS_TEXT,
    TARGET,
    Float,
    box_corners,
    plain_text,
    to_camera,
)

FILLS: tuple[RGB, ...] = ((66, 133, 244), (171, 71, 188), (0, 172, 193), (124, 179, 66), (240, 98, 146), (141, 110, 99))

MIN_WIDTH_PX = 480
"""Narrower images are enlarged by a whole factor, so that the text stays readable."""
SHARPNESS = 2
"""Vector shapes are drawn this much larger and then averaged, which smooths their edges."""
NEAR_M = 0.02
STEM_M = 0.10


def draw_overlay(decision: Decision, gripper: Gripper) -> Image.Image:
    """Draw a decision over its colour image, with a caption below.

    Args:
        decision: Any status; what it lacks is not drawn.
        gripper: Geometry of the gripper to draw at the chosen grasp.

    Returns:
        RGB image as wide as the frame (a multiple of it when narrower than MIN_WIDTH_PX) and taller by the caption.
    """
    frame = decision.scene.frame
    scale = -(-MIN_WIDTH_PX // frame.camera.width)
    base = Image.fromarray(_tinted(decision)).resize(
        (frame.camera.width * scale, frame.camera.height * scale), Image.Resampling.NEAREST
    )
    sheet = _Sheet(base.size, scale)
    sheet.outlines(decision)
    target = decision.target
    if target is not None:
        sheet.grid(target.box_xyxy, decision.plan.grid, decision.plan.cell)
    if decision.grasp is not None:
        sheet.gripper(decision.grasp, gripper, frame.camera)
    if decision.preferred_point is not None and decision.preferred_point[2] > NEAR_M:
        sheet.point(frame.camera.project(decision.preferred_point))
    if target is None:
        sheet.marks(decision.scene.proposals)
    else:
        cell = cell_box(target.box_xyxy, decision.plan.grid, decision.plan.cell)
        sheet.marks(decision.scene.proposals, target.mark, cell)
        sheet.cell_number(target.box_xyxy, decision.plan.grid, decision.plan.cell)
        sheet.tag(target.box_xyxy, target.label, decision.plan.grid, decision.plan.cell)
    picture = Image.alpha_composite(base.convert("RGBA"), sheet.flatten()).convert("RGB")
    return _with_caption(picture, decision)


def _tinted(decision: Decision) -> NDArray[np.uint8]:
    """The colour image with a translucent fill per proposal, stronger on the target."""
    image = decision.scene.frame.color.astype(np.float32)
    for proposal in decision.scene.proposals:
        _blend(image, proposal.mask, FILLS[(proposal.mark - 1) % len(FILLS)], 0.12)
    if decision.target is not None:
        _blend(image, decision.target.mask, TARGET, 0.30)
    return np.round(image).astype(np.uint8)


def _blend(image: NDArray[np.float32], mask: Mask, color: RGB, alpha: float) -> None:
    image[mask] = (1 - alpha) * image[mask] + alpha * np.array(color, np.float32)


def _font(size_px: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=max(6.0, size_px))


class _Sheet:
    """A transparent layer over the image; coordinates given to it are image pixels with centres at integers."""

    def __init__(self, size: tuple[int, int], scale: int) -> None:
        self._k = scale * SHARPNESS
        self._size = size
        self._layer = Image.new("RGBA", (size[0] * SHARPNESS, size[1] * SHARPNESS), (0, 0, 0, 0))
        self._draw = ImageDraw.Draw(self._layer)
        self._unit = SHARPNESS * max(1.0, size[0] / 640)
        """One "point" on the layer: line widths and text follow the picture's size."""

    def flatten(self) -> Image.Image:
        return self._layer.reduce(SHARPNESS)

    def _xy(self, uv: NDArray[np.floating] | Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(float(u), float(v)) for u, v in (np.asarray(uv, np.float64) + 0.5) * self._k]

    def _line(self, uv: Sequence[tuple[float, float]] | Float, color: RGB, width: float, alpha: int = 255) -> None:
        self._draw.line(self._xy(uv), (*color, alpha), max(1, round(width * self._unit)), joint="curve")

    def outlines(self, decision: Decision) -> None:
        """A thin light line inside each mask; a stronger one with a dark edge around the target."""
        thin = max(1, round(0.5 * self._unit))
        for proposal in decision.scene.proposals:
            self._paint_edge(proposal.mask, PAPER, 190, thin)
        if decision.target is not None:
            self._paint_edge(decision.target.mask, INK, 200, round(2.0 * self._unit))
            self._paint_edge(decision.target.mask, TARGET, 255, round(1.1 * self._unit))

    def _paint_edge(self, mask: Mask, color: RGB, alpha: int, half_width: int) -> None:
        window = _window(mask)
        if window is None:
            return
        rows, columns = window
        big = np.kron(np.pad(mask[rows, columns], 1), np.ones((self._k, self._k), bool))
        inside, outside = (np.asarray(ndimage.distance_transform_edt(m)) for m in (big, ~big))
        distance = np.where(big, inside, outside - 1)
        edge = Image.fromarray(((distance <= half_width) * alpha).astype(np.uint8))
        corner = ((columns.start - 1) * self._k, (rows.start - 1) * self._k)
        self._layer.paste(Image.new("RGBA", edge.size, (*color, alpha)), corner, edge.point(lambda a: 255 if a else 0))

    def grid(self, box: BoxXYXY, grid: int, cell: int) -> None:
        """The target's box, its k x k cells, and the chosen cell with its number."""
        chosen = _outline(cell_box(box, grid, cell))
        self._draw.polygon(self._xy(chosen), fill=(*TARGET, 96))
        bx0, by0, bx1, by1 = (b - 0.5 for b in box)
        for i in range(1, grid):
            x, y = bx0 + i * (bx1 - bx0) / grid, by0 + i * (by1 - by0) / grid
            self._line([(x, by0), (x, by1)], PAPER, 0.7, 150)
            self._line([(bx0, y), (bx1, y)], PAPER, 0.7, 150)
        self._line(_outline(box), INK, 3.0, 170)
        self._line(_outline(box), TARGET, 1.6)
        self._line(chosen, TARGET, 1.2)

    def _cell_holds_number(self, box: BoxXYXY, grid: int) -> bool:
        return min(box[2] - box[0], box[3] - box[1]) / grid * self._k >= 15 * self._unit

    def cell_number(self, box: BoxXYXY, grid: int, cell: int) -> None:
        """The chosen cell's number in its top-left corner, when there is room."""
        if not self._cell_holds_number(box, grid):
            return
        x0, y0, _, _ = cell_box(box, grid, cell)
        x, y = self._xy([(x0 - 0.5, y0 - 0.5)])[0]
        at = (x + 2.5 * self._unit, y + 1.0 * self._unit)
        self._draw.text(
            at, str(cell), PAPER, _font(9 * self._unit), stroke_width=round(0.9 * self._unit), stroke_fill=INK
        )

    def gripper(self, grasp: Grasp, gripper: Gripper, camera: CameraIntrinsics) -> None:
        """Fingers, palm and approach stem in perspective."""
        inside = _view_limits(camera)
        palm_end = -gripper.finger_length_m - gripper.palm_size_m[2]
        stem = to_camera(grasp, np.array([[0, 0, palm_end], [0, 0, palm_end - STEM_M]]))
        stem = _clip(stem, inside)
        boxes = gripper.bodies(grasp.width_m)
        distance = np.linalg.norm(to_camera(grasp, boxes.mean(axis=1)), axis=1)
        fingers = (0, 1) if distance[0] > distance[1] else (1, 0)
        if len(stem) >= 2:
            self._line(camera.project(stem[:2]), INK, 5.0, 170)
            self._line(camera.project(stem[:2]), GRIPPER, 3.0, 200)
        for i in (2, *fingers):  # the palm first and to look through, so that it hides no finger
            layer = Image.new("RGBA", self._layer.size, (0, 0, 0, 0))
            draw = ImageDraw.Draw(layer)
            for quad, light in _front_faces(to_camera(grasp, box_corners(boxes[i]))):
                polygon = _clip(quad, inside)
                if len(polygon) < 3:
                    continue
                xy = self._xy(camera.project(polygon))
                fill = tuple(round(c * light) for c in GRIPPER)
                draw.polygon(xy, fill=(*fill, 70 if i == 2 else 215))
                draw.line([*xy, xy[0]], (*INK, 120 if i == 2 else 230), max(1, round(1.0 * self._unit)))
            window = layer.getbbox()
            if window is not None:
                self._layer.alpha_composite(layer.crop(window), window[:2])
        pads = _clip(to_camera(grasp, np.array([[-grasp.width_m / 2, 0, 0], [grasp.width_m / 2, 0, 0]])), inside)
        if len(pads) >= 2:
            self._line(camera.project(pads[:2]), PAPER, 1.0, 220)

    def point(self, uv: Float) -> None:
        """The preferred point."""
        (x, y), r = self._xy(uv[None])[0], 3.6 * self._unit
        self._draw.ellipse(
            [x - r, y - r, x + r, y + r], fill=(*POINT, 255), outline=(*PAPER, 255), width=round(1.2 * self._unit)
        )

    def marks(
        self,
        proposals: Sequence[Proposal],
        target_mark: int | None = None,
        cell: tuple[float, float, float, float] | None = None,
    ) -> None:
        """Numbered pills, each inside its mask, clear of the others and of the chosen cell where there is room."""
        placed: list[tuple[float, float]] = []
        font = _font(10 * self._unit)
        for proposal in sorted(proposals, key=lambda p: int(p.mask.sum())):
            is_target = proposal.mark == target_mark
            seat = _seat(proposal.mask, placed, 13 * self._unit / self._k, cell if is_target else None)
            if seat is None:
                continue
            placed.append(seat)
            x, y = self._xy([seat])[0]
            self._pill(x, y, str(proposal.mark), font, TARGET if is_target else PAPER)

    def _pill(
        self, x: float, y: float, text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, paper: RGB
    ) -> None:
        left, top, right, bottom = self._draw.textbbox((0, 0), text, font)
        h = (bottom - top) / 2 + 2.6 * self._unit
        w = max((right - left) / 2 + 4 * self._unit, h)
        x = float(np.clip(x, w, max(w, self._layer.width - w)))
        y = float(np.clip(y, h, max(h, self._layer.height - h)))
        self._draw.rounded_rectangle(
            [x - w, y - h, x + w, y + h], h, (*paper, 235), (*INK, 255), max(1, round(0.6 * self._unit))
        )
        self._draw.text((x - (left + right) / 2, y - (top + bottom) / 2), text, (*INK, 255), font)

    def tag(self, box: BoxXYXY, label: str, grid: int, cell: int) -> None:
        """The target's name below its box (above where there is no room), with the cell when it could not hold it.

        The gripper mostly comes from above.
        """
        words = plain_text(label)
        if not self._cell_holds_number(box, grid):
            words = f"{words} · cell {cell}".lstrip(" ·")
        if not words:
            return
        font = _font(10 * self._unit)
        words = _ellipsize(words, font, self._layer.width - 12 * self._unit)
        (x, y0), (_, y1) = self._xy([(box[0] - 0.5, box[1] - 0.5), (box[0] - 0.5, box[3] - 0.5)])
        w, h = font.getlength(words) + 8 * self._unit, 15 * self._unit
        x = float(np.clip(x, 0, max(0.0, self._layer.width - w)))
        y = y1 + 3 * self._unit
        if y + h > self._layer.height:
            y = max(y0 - h - 3 * self._unit, 0.0)
        self._draw.rounded_rectangle([x, y, x + w, y + h], 3 * self._unit, (*TARGET, 240))
        self._draw.text((x + 4 * self._unit, y + h / 2), words, (*INK, 255), font, anchor="lm")


def _outline(box: tuple[float, float, float, float]) -> list[tuple[float, float]]:
    """The closed border of a half-open pixel box."""
    x0, y0, x1, y1 = (b - 0.5 for b in box)
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]


def _window(mask: Mask) -> tuple[slice, slice] | None:
    found = ndimage.find_objects(mask.astype(np.uint8))
    return found[0] if found else None


def _seat(
    mask: Mask,
    placed: Sequence[tuple[float, float]],
    clearance_px: float,
    avoid: tuple[float, float, float, float] | None,
) -> tuple[float, float] | None:
    """The pixel (u, v) deepest inside a mask, away from seats already taken and from a box where possible."""
    window = _window(mask)
    if window is None:
        return None
    rows, columns = window
    depth: Float = np.asarray(ndimage.distance_transform_edt(np.pad(mask[rows, columns], 1)))[1:-1, 1:-1]
    v, u = np.nonzero(depth)
    score = depth[v, u]
    u, v = u + columns.start, v + rows.start
    for x, y in placed:
        score -= np.where(np.hypot(u - x, v - y) < clearance_px, 1e6, 0.0)
    if avoid is not None:
        pad = clearance_px / 2
        near_x = (u > avoid[0] - pad) & (u < avoid[2] + pad)
        score -= np.where(near_x & (v > avoid[1] - pad) & (v < avoid[3] + pad), 1e3, 0.0)
    best = int(np.argmax(score))
    return float(u[best]), float(v[best])


def _front_faces(corners: Float) -> list[tuple[Float, float]]:
    """The faces (4, 3) of a box that look at the camera, each with a brightness 0.55..1."""
    center = corners.mean(axis=0)
    faces: list[tuple[Float, float]] = []
    for face in BOX_FACES:
        quad = corners[list(face)]
        outward = quad.mean(axis=0) - center
        middle = quad.mean(axis=0)
        lengths = float(np.linalg.norm(outward) * np.linalg.norm(middle))
        facing = -float(outward @ middle) / max(lengths, 1e-9)
        if facing > 0:
            faces.append((quad, 0.55 + 0.45 * facing))
    return faces


def _view_limits(camera: CameraIntrinsics) -> Float:
    """Half-spaces (5, 4), n . p + d >= 0: in front of the camera and within one image size around the image."""
    w, h = camera.width, camera.height
    return np.array(
        [
            [0, 0, 1, -NEAR_M],
            [camera.fx, 0, camera.cx + w, 0],
            [-camera.fx, 0, 2 * w - camera.cx, 0],
            [0, camera.fy, camera.cy + h, 0],
            [0, -camera.fy, 2 * h - camera.cy, 0],
        ],
        np.float64,
    )


def _clip(points: Float, limits: Float) -> Float:
    """Cut a polygon (or a segment) (N, 3) by half-spaces (Sutherland-Hodgman); may return no points."""
    for *normal, offset in limits:
        if len(points) == 0:
            break
        side = points @ np.array(normal) + offset
        kept: list[Float] = []
        for i in range(len(points)):
            a, b, sa, sb = points[i - 1], points[i], side[i - 1], side[i]
            if (sa >= 0) != (sb >= 0):
                kept.append(a + (b - a) * (sa / (sa - sb)))
            if sb >= 0:
                kept.append(b)
        points = np.array(kept).reshape(-1, 3)
    if len(points) > 2 and np.allclose(points, points[:1]):
        return points[:0]
    return points


def _ellipsize(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> str:
    if font.getlength(text) <= width:
        return text
    low, high = 0, len(text)
    while low < high:
        middle = (low + high + 1) // 2
        if font.getlength(text[:middle].rstrip() + "…") <= width:
            low = middle
        else:
            high = middle - 1
    return text[:low].rstrip() + "…"


def _wrap(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float, lines: int) -> list[str]:
    """At most so many lines; the last is cut with an ellipsis."""
    words, wrapped = text.split(" "), [""]
    for i, word in enumerate(words):
        longer = f"{wrapped[-1]} {word}".strip()
        if font.getlength(longer) <= width or not wrapped[-1]:
            wrapped[-1] = longer
        elif len(wrapped) == lines:
            wrapped[-1] = " ".join([wrapped[-1], *words[i:]])
            break
        else:
            wrapped.append(word)
    return [_ellipsize(line, font, width) for line in wrapped]


def _with_caption(picture: Image.Image, decision: Decision) -> Image.Image:
    """Put status, instruction, rationale and fallbacks on a dark bar below the picture."""
    size = float(np.clip(picture.width / 45, 12, 20))
    margin, line = round(0.8 * size), round(1.5 * size)
    head, body = _font(1.05 * size), _font(0.95 * size)
    width = picture.width - 2 * margin
    status = STATUS_TEXT[decision.status]
    pill_width = head.getlength(status) + size
    rows: list[tuple[str, RGB]] = []
    rationale = plain_text(decision.plan.rationale)
    if rationale:
        rows += [(row, PAPER) for row in _wrap(rationale, body, width, 2)]
    if decision.degraded:
        fell = "; ".join(plain_text(f"{d.stage}: {d.reason}, so {d.fallback}") for d in decision.degraded)
        rows.append((_ellipsize(f"Fallbacks: {fell}", body, width), MUTED))
    height = 2 * margin + line * (1 + len(rows))
    sheet = Image.new("RGB", (picture.width, picture.height + height), INK)
    sheet.paste(picture, (0, 0))
    draw = ImageDraw.Draw(sheet)
    y = picture.height + margin
    draw.rounded_rectangle([margin, y, margin + pill_width, y + 1.25 * size], 0.35 * size, STATUS[decision.status])
    draw.text((margin + pill_width / 2, y + 0.62 * size), status, INK, head, anchor="mm")
    said = _ellipsize(f"“{plain_text(decision.instruction)}”", head, width - pill_width - 0.6 * size)
    draw.text((margin + pill_width + 0.6 * size, y + 0.62 * size), said, PAPER, head, anchor="lm")
    for i, (text, color) in enumerate(rows):
        draw.text((margin, y + line * (i + 1) + 0.62 * size), text, color, body, anchor="lm")
    return sheet
