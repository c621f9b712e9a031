"""The closed loop on a real robot: what `thinkgrasp run` runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from thinkgrasp import registry
from thinkgrasp.cameras.calibration import read_calibration
from thinkgrasp.cameras.placed import PlacedCamera
from thinkgrasp.config import PipelineConfig, make_pipeline, override, to_json
from thinkgrasp.episode import EpisodeHeader, EpisodeModel
from thinkgrasp.errors import ConfigError, PluginNotFound, ThinkGraspError
from thinkgrasp.handeye.camera_file import read_pose, read_record
from thinkgrasp.interfaces import Camera, Robot
from thinkgrasp.lab.cell import Cell, load_cell
from thinkgrasp.lab.guarded import GuardedRobot
from thinkgrasp.lab.journal import Journal
from thinkgrasp.lab.person import Person
from thinkgrasp.loop import END_WORDS, run_episode
from thinkgrasp.loop_stages import for_the_loop
from thinkgrasp.memory import Memory
from thinkgrasp.outputs import write_atomic
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.recorder import EpisodeRecorder
from thinkgrasp.telling import Teller
from thinkgrasp.types import Decision, Frame

if TYPE_CHECKING:
    from thinkgrasp.lab.agreement import CalibrationRecord

JOURNAL_FILE = "robot.jsonl"
NOW_FILE = "now.png"
_OFFERED = ("cell", "person", "journal", "dry_run", "record", "planner")
"""What a robot's factory gets beside its own settings, as far as it takes it."""


@dataclass(frozen=True)
class RunOptions:
    """What to run on what."""

    instruction: str
    robot: str = "ur"
    camera: str = "realsense"
    cell: Path | None = None
    dry_run: bool = False
    speed: float = 1.0
    """Share of the cell's speeds."""
    steps: int = 15
    arm_planner: str = "rrt_connect"
    robot_settings: Mapping[str, object] = field(default_factory=dict[str, object])
    camera_settings: Mapping[str, object] = field(default_factory=dict[str, object])
    """Over those of the cell file."""


@dataclass(frozen=True)
class RunResult:
    """The recorded episode, and why the robot stands still now (None: it waits at home)."""

    episode: EpisodeModel
    halted: str | None


def run_on_robot(
    options: RunOptions, preset: str, config: PipelineConfig, person: Person, out: Path, tell: Callable[[str], None]
) -> RunResult:
    """Look, decide, ask, move, verify, until the goal is in the bin.

    Args:
        options: What to run.
        preset: The name that is recorded.
        config: The pipeline's stages; saved as the loop runs them.
        person: Asked before each motion.
        out: Folder for the records, report.html, the robot's log and config.json.
        tell: Gets one line of progress at a time.

    Raises:
        ConfigError: Cell, robot or camera cannot be used.
        InputError: A camera file cannot be used; or the camera fails while it runs. What was finished is recorded, as
            it is when the run is interrupted.
        MissingDependency: A driver is not installed.
    """
    config = for_the_loop(config)
    make_pipeline(config)  # what cannot be used is refused before anything is connected
    cell = None if options.cell is None else load_cell(options.cell).slowed(options.speed)
    if cell is None and options.speed != 1.0:
        raise ConfigError("--speed is a share of a cell's limits: it needs --cell")
    camera_file = _camera_file(options, cell)
    journal = Journal(out / JOURNAL_FILE)
    journal.note("run", instruction=options.instruction, robot=options.robot, dry_run=options.dry_run)
    with ExitStack() as stack:
        settings = {**(cell.camera.settings if cell and cell.camera else {}), **options.camera_settings}
        camera = cast(Camera, registry.load("camera", options.camera, **settings))
        stack.callback(_close, camera)
        record = None if camera_file is None else read_record(camera_file)
        robot = _robot(options, cell, person, journal, record, stack)
        pipeline = _pipeline(config, robot)
        header = EpisodeHeader(instruction=options.instruction, goal="", preset=preset, seed=config.seed)
        recorder = EpisodeRecorder(out, header=header, gripper=pipeline.gripper)
        write_atomic(out / "config.json", to_json(config).encode())
        placed = _placed(camera, cell, camera_file, robot)
        announcing = _Announcing(pipeline, out / NOW_FILE, tell)
        try:
            prepare = getattr(robot, "prepare", None)
            if prepare is not None:
                prepare(placed.read())
            episode = run_episode(
                [placed],
                cast(Pipeline, announcing),
                robot,
                options.instruction,
                step_limit=1 if options.dry_run else options.steps,
                recorders=[recorder, Teller(tell)],
                stop=lambda: getattr(robot, "halted", None) is not None,
            )
        except (ThinkGraspError, KeyboardInterrupt) as error:
            end = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            journal.note(end, detail=str(error))
            if end == "interrupted" and not options.dry_run:
                tell("the robot was stopped where it is; look at it, and bring it home, before the next run")
            recorder.finish(end=end, success=False, usage=announcing.usage)
            raise
        halted = cast(str | None, getattr(robot, "halted", None))
        journal.note("end", end=episode.end, halted=halted)
        tell(f"{'dry run: nothing was moved' if options.dry_run else END_WORDS[episode.end]}")
        return RunResult(recorder.finish(end=episode.end, success=episode.success, usage=episode.usage), halted)


class _Announcing:
    """A pipeline that says and draws what it decided before a robot acts on it."""

    def __init__(self, pipeline: Pipeline, picture: Path, tell: Callable[[str], None]) -> None:
        from thinkgrasp.types import Usage

        self._pipeline, self._picture, self._tell = pipeline, picture, tell
        self.usage = Usage()

    def decide(self, frame: Frame, instruction: str, memory: Memory | None = None) -> Decision:
        """Decide, and show it."""
        import io

        from thinkgrasp.viz.overlay import draw_overlay

        decision = self._pipeline.decide(frame, instruction, memory)
        self.usage += decision.plan.usage
        buffer = io.BytesIO()
        draw_overlay(decision, self._pipeline.gripper).save(buffer, "PNG", compress_level=3)
        write_atomic(self._picture, buffer.getvalue())
        what = f"take {decision.plan.target} ({decision.plan.role})" if decision.plan.found else "take nothing"
        self._tell(f"plan: {what}: {decision.plan.rationale}; see {self._picture}")
        return decision


def _robot(
    options: RunOptions,
    cell: Cell | None,
    person: Person,
    journal: Journal,
    record: CalibrationRecord | None,
    stack: ExitStack,
) -> Robot:
    points = registry.available("robot")
    if options.robot not in points:
        raise PluginNotFound(f"no robot named {options.robot!r}; installed: {', '.join(points) or 'none'}")
    offered: dict[str, object] = {
        "cell": cell,
        "person": person,
        "journal": journal,
        "dry_run": options.dry_run,
        "record": record,
        "planner": options.arm_planner,
    }
    taken_over = sorted(set(options.robot_settings) & set(offered))
    if taken_over:
        raise ConfigError(
            f"--robot-set {', '.join(taken_over)}: that is said by the command's own options (--cell, --dry-run, "
            "--no-confirm, --arm-planner), and cannot be set beside them"
        )
    taken = _taken_by(points[options.robot].load(), offered)
    if "cell" in taken and cell is None:
        raise ConfigError(f"the robot {options.robot!r} needs --cell FILE; docs/real_robot.md says what is in it")
    robot = cast(Robot, registry.load("robot", options.robot, **{**taken, **options.robot_settings}))
    stack.callback(_close, robot)
    if {"person", "dry_run"} <= set(taken):
        return robot
    return GuardedRobot(robot, person=person, journal=journal, cell=cell, dry_run=options.dry_run)


def _taken_by(factory: Callable[..., object], offered: Mapping[str, object]) -> dict[str, object]:
    parameters = inspect.signature(factory).parameters
    return {name: value for name, value in offered.items() if name in parameters}


def _camera_file(options: RunOptions, cell: Cell | None) -> Path | None:
    """Return the camera file that the cell names, beside the cell file where its path is relative."""
    if cell is None or cell.camera is None or options.cell is None:
        return None
    return options.cell.parent / cell.camera.file


def _placed(camera: Camera, cell: Cell | None, camera_file: Path | None, robot: Robot) -> Camera:
    """Return the camera with its pose and the mask of the grasping area."""
    if cell is None or cell.camera is None or camera_file is None:
        return camera
    T = read_pose(camera_file, cell.camera.mount)
    if cell.camera.mount == "fixed":
        pose = lambda: T  # noqa: E731
    else:
        flange = getattr(robot, "T_world_flange", None)
        if flange is None:
            raise ConfigError("a camera on the hand needs a robot that says where its flange is: T_world_flange()")
        pose = lambda: flange() @ T  # noqa: E731
    box = np.array(cell.grasping_m) + np.array([[-0.02, -0.02, -0.02], [0.02, 0.02, 0.0]])
    return PlacedCamera(camera, pose, workspace_m=box, calibration=read_calibration(camera_file))


def _pipeline(config: PipelineConfig, robot: Robot) -> Pipeline:
    """Return the pipeline; its reach check asks about the robot's own arm, and is left out where it does not say."""
    motion = getattr(robot, "motion", None)
    if motion is None:
        return make_pipeline(replace(config, checks=tuple(c for c in config.checks if c.name != "reach")))
    if any(c.name == "reach" for c in config.checks):
        config = override(config, "checks.reach.motion", motion)
    return make_pipeline(config)


def _close(device: Any) -> None:
    close = getattr(device, "close", None)
    if close is not None:
        close()
