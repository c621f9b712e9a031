"""What the emulated model says of one picture: the truth, or something wrong, in the words that were asked for."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from thinkgrasp.benchmark.chat import Request
from thinkgrasp.benchmark.perfect_model import PictureTruth, frozen, view_that_shows
from thinkgrasp.selection import middle_cell
from thinkgrasp.testbed import Session
from thinkgrasp.types import BoxXYXY, Role

FROM_TRUTH = "[emulator: read from the simulator's truth]"
MAX_LISTED = 6
"""Objects that a reply speaks of."""
JUDGED_WIDTH_PX = 320
"""Larger pictures are judged at this width."""


@dataclass(frozen=True)
class Said:
    """What there is to say, before it is put into words."""

    taken: int
    mark: int | None
    box: BoxXYXY
    """Of the picture [px]."""
    cell: int
    pixel: tuple[int, int]
    """(u, v) of the picture."""
    part: str | None
    role: Role
    is_goal_seen: bool
    because: str


class PictureAnswer:
    """One request's picture against the truth; everything is judged at JUDGED_WIDTH_PX at most."""

    def __init__(self, session: Session, request: Request, grid: int) -> None:
        self._session = session
        self._request = request
        self._grid = grid
        h, w = request.picture.shape[:2]
        self._scale = min(1.0, JUDGED_WIDTH_PX / w)
        size = (round(w * self._scale), round(h * self._scale))
        small = np.asarray(Image.fromarray(request.picture).resize(size))
        world = frozen(session.world)
        self._truth = PictureTruth(world, view_that_shows(world, session.views, small), session.goals)
        self._boxes = {mark: self._judged(box) for mark, box in request.marks.items()}
        self._objects = {mark: self._truth.object_in(box) for mark, box in self._boxes.items()}
        self._ways = self._truth.ways()

    def _judged(self, box: BoxXYXY) -> BoxXYXY:
        x0, y0, x1, y1 = (c * self._scale for c in box)
        return math.floor(x0), math.floor(y0), math.ceil(x1), math.ceil(y1)

    def _own_mark(self, index: int) -> int | None:
        """Return the mark whose box is most like an object's, of those that show the object."""
        own, box = [mark for mark, at in self._objects.items() if at == index], self._truth.box(index)
        return max(own, key=lambda mark: (_overlap(self._boxes[mark], box), -mark), default=None)

    def _mark_of(self, index: int) -> int | None:
        """Return an object's own mark; where it has none, that of the smallest box that holds most of it."""
        own, box = self._own_mark(index), self._truth.box(index)
        if own is not None:
            return own
        holding = [mark for mark, other in self._boxes.items() if _intersection(other, box) > 0.5 * _area(box)]
        return min(holding, key=lambda mark: (_area(self._boxes[mark]), mark), default=None)

    @property
    def _takeable(self) -> tuple[int, ...]:
        """Objects that a reply can name: in view and, where there are marks, marked."""
        marked = set(self._objects.values())
        return tuple(i for i in self._truth.in_view if not self._boxes or i in marked)

    def _can_be_named(self, index: int) -> bool:
        return index in self._truth.in_view and (not self._boxes or self._mark_of(index) is not None)

    def _is_left(self, index: int) -> bool:
        """Whether the request says that a thing is to be left, as taking it failed."""
        name = self._truth.name(index)
        return self._mark_of(index) in self._request.left_marks or any(
            n.startswith(name) for n in self._request.left_names
        )

    @property
    def _is_goal_seen(self) -> bool:
        return any(way[0] in self._truth.in_view for way in self._ways)

    def right(self) -> Said | None:
        """Return the goal, or what is in its way, or a neighbour of what is to be left; None where no goal is left."""
        ends: list[Said] = []
        for way in self._ways:
            end = next((i for i in reversed(way) if self._can_be_named(i)), None)
            if end is not None:
                names = " is under or behind ".join(map(self._truth.name, way))
                is_goal = end == way[0]
                because = "nothing is in its way" if is_goal else names
                ends.append(self._say(end, "goal" if is_goal else "obstruction", because))
                if not self._is_left(end):
                    return ends[-1]
        if not self._ways:
            return None
        stuck = self._ways[0][-1]
        others = [i for i in self._takeable if i != stuck and not self._is_left(i)]
        if others:
            nearest = min(others, key=lambda i: self._truth.distance_m(i, stuck))
            return self._say(nearest, "obstruction", f"it makes room beside {self._truth.name(stuck)}")
        return ends[0] if ends else None

    def wrong(self, rng: np.random.Generator) -> Said | None:
        """Return another object than the right one and than the goals, in the same role; None where there is none."""
        right, goals = self.right(), self._session.goals
        others = [i for i in self._takeable if i not in goals and (right is None or i != right.taken)]
        if not others:
            return None
        return self._say(int(rng.choice(others)), right.role if right else "goal", "drawn by chance, to be wrong")

    def _say(self, index: int, role: Role, because: str) -> Said:
        mark = self._mark_of(index)
        box = self._truth.box(index) if mark is None else self._boxes[mark]
        spot = self._truth.spot(index, box, self._grid, self._request.failed_cells(mark))
        sent = tuple(round(c / self._scale) for c in box)
        u, v = (int((c + 0.5) / self._scale) for c in spot.pixel)
        return Said(index, mark, (sent[0], sent[1], sent[2], sent[3]), spot.cell, (u, v), spot.part, role,
                    self._is_goal_seen, because)  # fmt: skip

    # -- words -------------------------------------------------------------------------------------------------------

    def words(self, said: Said | None) -> str:
        """Put an answer into the format that was asked for."""
        if self._request.format == "text" and not self._boxes:
            return self._text(said)
        data = self._data(said)
        wanted = self._request.properties or tuple(data)
        return json.dumps({key: data[key] for key in wanted if key in data})

    def _data(self, said: Said | None) -> dict[str, object]:
        if said is None:
            return {
                "visible": False, "target": "none", "mark": None, "role": "goal", "kind": "object",
                "cell": middle_cell(self._grid), "objects": [],
                "rationale": f"{FROM_TRUTH} no goal is left to take, or nothing that leads to it",
            }  # fmt: skip
        return {
            "visible": said.is_goal_seen,
            "target": self._truth.name(said.taken) + ("" if said.part is None else f": {said.part}"),
            "mark": said.mark,
            "role": said.role,
            "kind": "object" if said.part is None else "part",
            "cell": said.cell,
            "objects": [
                {"name": other.name, "mark": other.mark, "grasp_score": other.score, "cell": other.cell}
                for other in self._others(said)
            ],
            "rationale": f"{FROM_TRUTH} {self._truth.name(said.taken)}: {said.because}",
        }

    def _text(self, said: Said | None) -> str:
        if said is None:
            return f"Rationale: {FROM_TRUTH} no goal is left to take\nGoal visible: no\nSelected object: none"
        name = self._truth.name(said.taken)
        selected = f"Selected object: {name}" if said.part is None else f"Selected object part: {name}: {said.part}"
        rationale = f"Rationale: {FROM_TRUTH} {said.because}"
        visible = f"Goal visible: {'yes' if said.is_goal_seen else 'no'}"
        if self._request.wants_pixel:
            return "\n".join((rationale, visible, selected, f"Grasp pixel: {said.pixel}"))
        lines = [rationale, visible, selected, f"Cropping box: {said.box}", "Objects:"]
        lines += [f"- {o.name}: grasp score {o.score}, preferred cell {o.cell}" for o in self._others(said)]
        return "\n".join(lines)

    def _others(self, said: Said) -> list[_Listed]:
        """Return what was chosen, then what else is seen in its box."""
        listed = [_Listed(self._truth.name(said.taken), said.mark, 95, said.cell)]
        box = self._judged(said.box)
        for index in self._takeable:
            if index != said.taken and _intersection(self._truth.box(index), box) > 0 and len(listed) < MAX_LISTED:
                own = self._truth.box(index)
                score = round(90 * self._truth.seen_share(index))
                cell = self._truth.spot(index, own, self._grid).cell
                listed.append(_Listed(self._truth.name(index), self._own_mark(index), score, cell))
        return listed


@dataclass(frozen=True)
class _Listed:
    name: str
    mark: int | None
    score: int
    cell: int


def _area(box: BoxXYXY) -> int:
    return max(box[2] - box[0], 0) * max(box[3] - box[1], 0)


def _intersection(a: BoxXYXY, b: BoxXYXY) -> int:
    return _area((max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])))


def _overlap(a: BoxXYXY, b: BoxXYXY) -> float:
    common = _intersection(a, b)
    return common / max(_area(a) + _area(b) - common, 1)
