"""What a second view is worth, alone and fused with the first: things with a grasp, and how many of those are real.

    python benchmarks/multi_view.py --seeds 1

For every thing that the first camera's view of a heavy pile shows, the offline pipeline is asked for a grasp on it: on
that view alone, on both views fused, and on the other view alone. A grasp is real when the opened gripper, on its way
and at the grasp, meets none of the true surface (points of exact depth from many sides), and the true thing is between
its fingers. Nothing is executed. Noise as in `thinkgrasp demo`; the oracle tells only which thing a mask is.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, pi, sin
from typing import Literal, get_args

import numpy as np
import tyro
from numpy.typing import NDArray

from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.checks.collision import CollisionCheck
from thinkgrasp.fusion import fuse
from thinkgrasp.geometry import apply, deproject, invert
from thinkgrasp.memory import Memory
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.sim.options import CameraOptions
from thinkgrasp.sim.tasks import TASKS
from thinkgrasp.sim.truth import true_labels
from thinkgrasp.sim.views import CameraView, camera, look_at
from thinkgrasp.testbed import Session
from thinkgrasp.types import Frame, Grasp, Grasps, Plan, Scene, Segment, Segmentation

How = Literal["first", "fused", "other"]
CLEAR_M = 0.001
"""The true surface may come this near: its points are about 1.5 mm apart."""


@dataclass(frozen=True)
class Answer:
    """What became of one thing, by one way of looking."""

    pile: str
    thing: int
    how: How
    found: bool
    real: bool
    decision_ms: float


class Known:
    """Perception that was done already."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def perceive(self, frame: Frame) -> Scene:
        """Return it."""
        return self.scene


class Take:
    """A planner and segmenter that takes one mark."""

    def __init__(self, mark: int) -> None:
        self.mark = mark

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Plan to take it."""
        return Plan("it", "asked for", mark=self.mark)

    def segment(self, scene: Scene, plan: Plan) -> Segmentation:
        """Return its mask."""
        p = scene.proposal(self.mark)
        return Segmentation((Segment("it", 1.0, p.mask, p.box_xyxy, p.touches_border, p.mark),))


@dataclass(frozen=True, eq=False)
class Truth:
    """The surface of everything, world."""

    points: NDArray[np.float64]
    thing: NDArray[np.int32]

    @classmethod
    def of(cls, session: Session) -> Truth:
        """Look from all sides at three heights, without noise."""
        points: list[NDArray[np.floating]] = []
        things: list[NDArray[np.int32]] = []
        for height, away in ((0.75, 0.05), (0.5, 0.45), (0.2, 0.55)):
            for turn in range(6):
                angle = turn * pi / 3
                eye = (0.5 + away * cos(angle), away * sin(angle), height)
                view = CameraView(camera("l515", (320, 240)), look_at(eye, (0.5, 0.0, 0.02)))
                frame = SimulatedCamera(session.world, view, noise=None).read()
                seen = apply(view.T_world_camera, deproject(frame.depth, frame.camera).astype(np.float64))
                good = np.isfinite(seen).all(axis=-1) & (np.abs(seen[..., :2] - [0.5, 0]) < 0.4).all(axis=-1)
                points.append(seen[good])
                things.append(true_labels(session.world, view)[good])
        return cls(np.concatenate(points).astype(np.float64), np.concatenate(things))

    def is_real(self, grasp: Grasp, frame: Frame, thing: int, pipeline: Pipeline) -> bool:
        """Whether a grasp meets nothing and has the thing between its fingers."""
        assert frame.T_world_camera is not None
        local = apply(invert(frame.T_world_camera), self.points).astype(np.float32)
        f = np.float32
        one = Grasps(
            grasp.rotation[None].astype(f),
            grasp.position[None].astype(f),
            np.array([grasp.width_m], f),
            np.array([grasp.score], f),
        )
        near = local[np.linalg.norm(local - grasp.position, axis=1) < 0.4]
        scene = Scene(frame, near[None])
        mask = np.ones((1, len(near)), bool)
        check = CollisionCheck(margin_m=0.0, voxel_m=CLEAR_M)
        if not check.keep(scene, Segment("it", 1.0, mask, (0, 0, len(near), 1), False), one, pipeline.gripper)[0]:
            return False
        own = (local[self.thing == thing] - grasp.position) @ grasp.rotation
        between = np.abs(own[:, 0]) < grasp.width_m / 2
        between &= np.abs(own[:, 1]) < pipeline.gripper.finger_breadth_m / 2
        between &= (own[:, 2] < 0) & (own[:, 2] > -pipeline.gripper.finger_length_m)
        return int(between.sum()) >= 3


def look(session: Session, pile: str, how: How, frame: Frame, view: CameraView, truth: Truth) -> Iterator[Answer]:
    """Ask for a grasp on everything that a view shows, each true thing once."""
    pipeline = session.pipeline("offline")
    assert pipeline.scene is not None
    labels = true_labels(session.world, view)
    scene = pipeline.scene.perceive(frame)
    pipeline.scene = Known(scene)
    things: dict[int, tuple[int, int]] = {}
    for proposal in scene.proposals:
        counts = np.bincount(labels[proposal.mask] + 1)
        thing = int(counts.argmax()) - 1
        if thing >= 0 and counts.max() > things.get(thing, (0, 0))[1]:
            things[thing] = proposal.mark, int(counts.max())
    for thing, (mark, _) in things.items():
        pipeline.planner = pipeline.segmenter = Take(mark)
        decision = pipeline.decide(frame, "it")
        grasp = decision.grasp
        real = grasp is not None and truth.is_real(grasp, frame, thing, pipeline)
        yield Answer(pile, thing, how, grasp is not None, real, dict(decision.timings_ms)["total"])


def report(answers: list[Answer]) -> str:
    """Return the table."""
    shown = {(a.pile, a.thing) for a in answers if a.how == "first"}
    table = {how: {(a.pile, a.thing): a for a in answers if a.how == how} for how in get_args(How)}
    lines = [
        f"{len(shown)} things that the first view shows",
        "",
        "| | a grasp | of them real | ms a decision (median) |",
    ]
    lines.append("|---|---|---|---|")
    for how, found in table.items():
        own = [found[key] for key in shown if key in found]
        got = [a for a in own if a.found]
        median = float(np.median([a.decision_ms for a in own])) if own else float("nan")
        lines.append(f"| {how} | {len(got)} | {sum(a.real for a in got)} | {median:.0f} |")
    without = [key for key in shown if not table["first"][key].found]
    lines += [
        "",
        f"{len(without)} of them have no grasp on the first view. Then:",
        "",
        "| | a grasp | real |",
        "|---|---|---|",
    ]
    for order in (("fused",), ("other",), ("fused", "other"), ("other", "fused")):
        chosen = [next((table[h][k] for h in order if k in table[h] and table[h][k].found), None) for k in without]
        got = [a for a in chosen if a is not None]
        lines.append(f"| {', then '.join(order)} | {len(got)} | {sum(a.real for a in got)} |")
    return "\n".join(lines)


def main(seeds: int = 1, first_seed: int = 0, camera_model: Literal["l515", "d455"] = "l515", limit: int = 6) -> None:
    """Run it and print the table.

    Args:
        seeds: Piles per heavy task.
        first_seed: Of the first pile.
        camera_model: Whose noise.
        limit: Tasks at most.
    """
    answers: list[Answer] = []
    for task in [t for t in TASKS if t.suite == "heavy"][:limit]:
        for seed in range(first_seed, first_seed + seeds):
            session = Session(task.scene(seed), CameraOptions(camera_model), seed=seed)
            truth = Truth.of(session)
            first, other = (camera.read() for camera in session.cameras)
            pile = f"{task.name}/{seed}"
            views: dict[How, tuple[Frame, CameraView]] = {
                "first": (first, session.views[0]),
                "fused": (fuse([first, other]), session.views[0]),
                "other": (other, session.views[1]),
            }
            for how, (frame, view) in views.items():
                answers += look(session, pile, how, frame, view, truth)
            print(f"{pile} done; so far:\n{report(answers)}", file=sys.stderr, flush=True)
    print(report(answers))


if __name__ == "__main__":
    tyro.cli(main)
