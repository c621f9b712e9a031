"""One simulated episode from start to end: the cell with its pile, cameras, robot and pipeline, and the referee."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from thinkgrasp import loop
from thinkgrasp.cameras.simulated import SimulatedCamera
from thinkgrasp.config import PipelineConfig, load_config, make_pipeline
from thinkgrasp.interfaces import Recorder
from thinkgrasp.loop_stages import for_the_loop
from thinkgrasp.motion.arm import OWN_PLANNER, ArmMotion
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.robots.simulated import SimulatedRobot, Truth
from thinkgrasp.sim.options import CameraOptions
from thinkgrasp.sim.oracle import ORACLE, oracle_pipeline
from thinkgrasp.sim.scenes import PiledScene
from thinkgrasp.sim.views import CameraView, default_view, side_view
from thinkgrasp.sim.world import World
from thinkgrasp.types import Frame, Grasp, Outcome


@dataclass(frozen=True, eq=False)
class Attempt:
    """What really happened in one attempt, beside what the robot reported."""

    outcome: Outcome
    truth: Truth
    moved_out: tuple[int, ...]
    """Objects that left the table without being taken."""


@dataclass(frozen=True, eq=False)
class SimulatedEpisode:
    """A run of the loop, and the truth about it."""

    episode: loop.Episode
    attempts: tuple[Attempt, ...]
    goals: tuple[int, ...]


class Session:
    """A pile in the cell, ready to be worked on.

    Args:
        scene: What lies on the table.
        camera: Which sensor, by default the L515 at 640x480.
        views: Where cameras stand and what they are; the first is looked through, the others where it shows no grasp.
            By default one of `camera` faces the robot and another looks from the side.
        seed: Of the sensors' noise.
        arm_planner: Finds the arm's paths: "rrt_connect", or a planner of the OMPL such as "RRTstar".

    Raises:
        ConfigError: A camera or planner that is not offered.
        MissingDependency: The planner is one of the OMPL, which is not installed.
    """

    def __init__(
        self,
        scene: PiledScene,
        camera: CameraOptions | None = None,
        *,
        views: Sequence[CameraView] | None = None,
        seed: int = 0,
        arm_planner: str = OWN_PLANNER,
    ) -> None:
        camera = camera or CameraOptions()
        self.scene = scene
        self.world = World(scene.spec.objects)
        for index, T in enumerate(scene.poses):
            self.world.place(index, T)
        self.world.settle(max_seconds=1.0)
        self.views = tuple(views or (view(camera.model, camera.size_wh) for view in (default_view, side_view)))
        noise = camera.model if camera.noise else None
        self.cameras = tuple(
            SimulatedCamera(self.world, view, noise=noise, seed=seed * len(self.views) + i)
            for i, view in enumerate(self.views)
        )
        self.robot = _Witness(SimulatedRobot(self.world, ArmMotion(planner=arm_planner)))

    @property
    def goals(self) -> tuple[int, ...]:
        """Indices of the objects that serve the instruction."""
        return self.scene.spec.goals

    def watch(self, watcher: Callable[[], None]) -> None:
        """Have someone called about every 0.1 s of simulated time, for videos and live views."""
        self.robot.robot.watchers.append(watcher)

    def goal_delivered(self) -> bool:
        """Whether a goal lies in the bin: what the person at the bin sees."""
        return any(self.world.in_bin(g) for g in self.goals)

    def pipeline(self, preset: str | PipelineConfig) -> Pipeline:
        """Return the pipeline that the loop runs here; the oracle's has the truth of this session."""
        config = load_config("offline") if preset == ORACLE else preset
        config = for_the_loop(config if isinstance(config, PipelineConfig) else load_config(config))
        return oracle_pipeline(config, self.world, self.goals) if preset == ORACLE else make_pipeline(config)

    def run(
        self,
        pipeline: Pipeline,
        *,
        step_limit: int,
        instruction: str | None = None,
        recorders: Iterable[Recorder] = (),
        stop: Callable[[], bool] = lambda: False,
        fusion: loop.Fusion = "last",
    ) -> SimulatedEpisode:
        """Run the loop until a goal is in the bin, or it ends otherwise."""
        before = len(self.robot.attempts)
        episode = loop.run_episode(
            self.cameras,
            pipeline,
            self.robot,
            instruction or self.scene.spec.instruction,
            step_limit=step_limit,
            referee=lambda decision, outcome: self.goal_delivered(),
            recorders=recorders,
            stop=stop,
            fusion=fusion,
        )
        return SimulatedEpisode(episode, tuple(self.robot.attempts[before:]), self.goals)


class _Witness:
    """A robot that notes, for statistics, what really happened in every attempt."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self.robot = robot
        self.attempts: list[Attempt] = []

    def execute(self, grasp: Grasp, frame: Frame) -> Outcome:
        world = self.robot.world
        before = [world.on_table(i) for i in range(len(world.objects))]
        outcome = self.robot.execute(grasp, frame)
        left = [i for i, was in enumerate(before) if was and not world.on_table(i)]
        gone = tuple(i for i in left if i != self.robot.truth.delivered)
        self.attempts.append(Attempt(outcome, self.robot.truth, gone))
        return outcome
