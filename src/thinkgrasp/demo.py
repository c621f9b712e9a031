"""One closed-loop episode in simulation, recorded, filmed and shown: what `thinkgrasp demo` runs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thinkgrasp.config import PipelineConfig, make_pipeline, to_json
from thinkgrasp.episode import VIDEO_FILE, EpisodeHeader, EpisodeModel
from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.interfaces import Recorder
from thinkgrasp.loop import END_WORDS
from thinkgrasp.outputs import write_atomic
from thinkgrasp.recorder import EpisodeRecorder
from thinkgrasp.telling import Teller
from thinkgrasp.types import Decision, Outcome
from thinkgrasp.viz.live import LiveView
from thinkgrasp.viz.video import VideoWriter

if TYPE_CHECKING:
    from thinkgrasp.sim.options import CameraOptions
    from thinkgrasp.sim.scenes import PiledScene
    from thinkgrasp.testbed import Session

DEFAULT_INSTRUCTION = "I need a fruit"
DEFAULT_STEPS = 15


@dataclass(frozen=True)
class DemoOptions:
    """What to run.

    Without a task, the pile holds one thing that serves the instruction among ten that do not.
    """

    instruction: str | None = None
    task: str | None = None
    objects: Path | None = None
    """Folder of the user's own objects, of which the instruction names one."""
    seed: int = 0
    steps: int | None = None
    """Attempts; None = as many as the task allows."""
    visibility: Literal["visible", "partly", "hidden"] | None = None
    """Of what serves the instruction; None = the task's, or hidden where nothing was asked for."""
    video: bool = True
    live_port: int | None = None
    arm_planner: str = "rrt_connect"
    """Finds the arm's paths; or a planner of the OMPL such as "RRTstar"."""


def run_demo(
    options: DemoOptions,
    preset: str,
    config: PipelineConfig,
    camera: CameraOptions,
    out: Path,
    tell: Callable[[str], None],
) -> EpisodeModel:
    """Make a pile, run the loop on it, and write everything into a folder.

    Args:
        options: What to run.
        preset: The name that is recorded; "oracle" reads the simulator's truth.
        config: The pipeline's stages; saved as the loop runs them.
        camera: Which sensor looks at the cell.
        out: Folder for the records, report.html, the video and config.json.
        tell: Gets one line of progress at a time.

    Raises:
        InputError: The instruction names nothing that there is, or the folder cannot be used.
        ConfigError: No such task or image size, or a setting that cannot be used.
        MissingDependency: The simulator is not installed.
    """
    try:
        import mujoco  # noqa: F401  (the simulator; everything below needs it)
    except ModuleNotFoundError as error:
        raise MissingDependency("mujoco-core", "sim", "the simulated episode") from error
    from thinkgrasp.motion.arm import path_planner
    from thinkgrasp.sim.oracle import ORACLE
    from thinkgrasp.sim.views import default_view
    from thinkgrasp.testbed import Session, for_the_loop

    config = for_the_loop(config)
    make_pipeline(config)  # what cannot be used is refused before the pile is made
    default_view(camera.model, camera.size_wh)
    path_planner(options.arm_planner)
    scene, steps = make_scene(options, tell)
    names = [scene.spec.objects[g].name for g in scene.spec.goals]
    shown = ", ".join(
        f"{name} ({share:.0%} in view)" for name, share in zip(names, scene.visible_fractions, strict=True)
    )
    tell(f"{len(scene.spec.objects)} objects on the table; what serves {scene.spec.instruction!r}: {shown}")
    header = EpisodeHeader(instruction=scene.spec.instruction, goal=", ".join(names), preset=preset, seed=options.seed)
    with ExitStack() as stack:
        session = Session(scene, camera, seed=options.seed, arm_planner=options.arm_planner)
        pipeline = session.pipeline(ORACLE if preset == ORACLE else config)
        recorder = EpisodeRecorder(out, header=header, gripper=pipeline.gripper)
        write_atomic(out / "config.json", to_json(config).encode())
        recorders: list[Recorder] = [recorder, Teller(tell)]
        if options.live_port is not None:
            live = stack.enter_context(LiveView(pipeline.gripper, port=options.live_port))
            recorders.insert(0, live)
            _show_world(session, live)
            tell(f"follow the episode at {live.url}")
        if options.video:
            mark = f"[{ORACLE}] " if preset == ORACLE else ""
            recorders.append(_Film(session, stack.enter_context(_video(out)), scene.spec.instruction, mark))
        episode = session.run(pipeline, step_limit=options.steps or steps, recorders=recorders).episode
    tell(f"{END_WORDS[episode.end]} after {len(episode.steps)} steps")
    return recorder.finish(end=episode.end, success=episode.success, usage=episode.usage)


def make_scene(options: DemoOptions, tell: Callable[[str], None] = lambda line: None) -> tuple[PiledScene, int]:
    """Return the pile and how many attempts there are.

    Raises:
        InputError: The instruction names nothing that there is; or a task with objects of one's own.
        ConfigError: No such task.
    """
    from thinkgrasp.sim.goals import goals_in
    from thinkgrasp.sim.tasks import find_task, task_for
    from thinkgrasp.sim.urdf import load_objects

    if options.task is None:
        own = load_objects(options.objects) if options.objects is not None else ()
        visibility = options.visibility or (None if options.instruction else "hidden")
        return task_for(options.instruction or DEFAULT_INSTRUCTION, options.seed, own, visibility), DEFAULT_STEPS
    if options.objects is not None:
        raise ConfigError("--task names a pile of catalogue objects; leave it out to use --objects")
    task = find_task(options.task)
    tell(f"making the pile of {task.name}")
    scene = task.scene(options.seed, options.visibility)
    if options.instruction is not None:
        goals = goals_in(options.instruction, scene.spec.objects)
        if not goals:
            there = ", ".join(sorted({o.name for o in scene.spec.objects}))
            raise InputError(f"nothing in the pile of {task.name} serves {options.instruction!r}; there is: {there}")
        spec = replace(scene.spec, instruction=options.instruction, goals=goals)
        scene = replace(scene, spec=spec, visible_fractions=_visible(scene, goals))
    return scene, task.step_limit


def _visible(scene: PiledScene, goals: tuple[int, ...]) -> tuple[float, ...]:
    from thinkgrasp.sim.truth import visible_fraction
    from thinkgrasp.sim.views import default_view
    from thinkgrasp.sim.world import World

    world = World(scene.spec.objects, robot=False)
    for index, T in enumerate(scene.poses):
        world.place(index, T)
    return tuple(visible_fraction(world, default_view(), g) for g in goals)


def _video(out: Path) -> VideoWriter:
    from thinkgrasp.sim.views import film_view

    camera = film_view().intrinsics
    return VideoWriter(out / VIDEO_FILE, size=(camera.width, camera.height))


class _Film:
    """Films the cell from aside; the caption says which step it is and what became of the one before.

    Every caption begins with `mark`.
    """

    def __init__(self, session: Session, video: VideoWriter, instruction: str, mark: str) -> None:
        from thinkgrasp.sim.views import film_view

        self._world = session.world
        self._view = film_view()
        self._video = video
        self._step = 1
        self._caption = instruction
        self._mark = mark
        session.watch(self.shoot)
        self.shoot()

    def shoot(self) -> None:
        from thinkgrasp.sim.render import render

        picture = render(self._world.model, self._world.data, self._view, self._world.visuals).color
        self._video.add(picture, self._mark + self._caption)

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        self._step += 1
        reason = "not taken" if outcome is None else outcome.reason.replace("_", " ")
        self._caption = f"step {self._step}, after {decision.plan.target}: {reason}"


def _show_world(session: Session, live: LiveView) -> None:
    from thinkgrasp.sim.shown import mesh_poses, shown_meshes

    meshes = shown_meshes(session.world)
    names = [m.name for m in meshes]
    live.set_meshes(names, [m.vertices for m in meshes], [m.faces for m in meshes], [m.color for m in meshes])

    def update() -> None:
        live.set_poses(names, *mesh_poses(session.world, meshes))

    update()
    session.watch(update)
