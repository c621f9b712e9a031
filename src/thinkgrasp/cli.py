"""The `thinkgrasp` command. stdout is the result, stderr the progress and errors.

Exit codes: 0 a grasp, or the goal in the bin; 1 neither; 2 bad input or configuration; 3 a bug in thinkgrasp or a
plug-in; 130 interrupted.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, UseAppendAction, arg, subcommand

from thinkgrasp import __version__
from thinkgrasp.bench_command import BenchCommand
from thinkgrasp.calibrate_command import CalibrateCommand
from thinkgrasp.errors import ConfigError, InputError, ThinkGraspError
from thinkgrasp.outputs import OVERLAY_SUFFIXES, check_writable, make_folder, one_line, write_atomic
from thinkgrasp.run_command import RunCommand
from thinkgrasp.serve_command import ServeCommand
from thinkgrasp.stage_options import DEFAULT_STAGES, StageOptions, configure

if TYPE_CHECKING:
    from thinkgrasp.gripper import Gripper
    from thinkgrasp.schema import DecisionModel
    from thinkgrasp.types import Decision

DONE, NOTHING, BAD_INPUT, BUG, INTERRUPTED = 0, 1, 2, 3, 130
ORACLE_STAGES = ("scene", "planner", "segmenter")
"""Replaced by the simulator's truth, so that settings of theirs would do nothing."""


@dataclass(frozen=True)
class GraspCommand:
    """Find a grasp for an instruction on one RGB-D frame."""

    color: Annotated[Positional[Path], arg(metavar="COLOR")]
    """Colour image."""
    depth: Annotated[Positional[Path], arg(metavar="DEPTH")]
    """Depth image aligned to it: 16-bit PNG or TIFF, float TIFF, or .npy."""
    instruction: Annotated[Positional[str], arg(metavar="INSTRUCTION")]
    """What to take, for example "the red box"."""
    camera: Path
    """Camera file: width, height, fx, fy, cx, cy, optional depth_scale and T_world_camera."""
    depth_scale: Annotated[float | None, arg(metavar="M_PER_UNIT")] = None
    """Metres per unit of the depth image; overrides the camera file (default 0.001)."""
    workspace_mask: Annotated[Path | None, arg(metavar="PATH")] = None
    """Image of the same size; non-zero = grasping is allowed."""
    also: Annotated[UseAppendAction[tuple[tuple[Path, Path, Path], ...]], arg(metavar="COLOR DEPTH CAMERA")] = ()
    """Another view of the same scene, its camera file and the first with T_world_camera; may be repeated."""
    json: bool = False
    """Print the decision as JSON."""
    overlay: Annotated[Path | None, arg(metavar="PATH")] = None
    """Write the annotated image here (.png, .jpg, .webp)."""
    view: Annotated[Path | None, arg(metavar="PATH")] = None
    """Write the 3-D view here (.html)."""
    server: Annotated[str | None, arg(metavar="URL")] = None
    """Let the server there decide (thinkgrasp serve); its token is read from THINKGRASP_TOKEN."""
    stages: tyro.conf.OmitArgPrefixes[StageOptions] = DEFAULT_STAGES

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        files = (
            self.color,
            self.depth,
            self.camera,
            self.workspace_mask,
            *(path for view in self.also for path in view),
        )
        inputs = [p for p in files if p is not None]
        _check_outputs(self.overlay, self.view, inputs)

        from thinkgrasp.cameras.files import load_frame
        from thinkgrasp.config import make_pipeline

        _check_text(self.instruction)
        config = configure(self.stages)
        frame = load_frame(
            self.color, self.depth, self.camera, depth_scale=self.depth_scale, workspace_mask=self.workspace_mask
        )
        if self.also and self.server is not None:
            raise ConfigError("--also needs a decision here: the server takes one view; leave out --server")
        if self.also:
            from thinkgrasp.fusion import describe, fuse

            frame = fuse([frame, *(load_frame(*view, depth_scale=self.depth_scale) for view in self.also)])
            _progress(describe(frame))
        if self.server is None:
            from thinkgrasp.schema import decision_to_schema

            pipeline = make_pipeline(config)
            decision = pipeline.decide(frame, self.instruction)
            _write_pictures(decision, pipeline.gripper, self.overlay, self.view)
            model, timings_ms = decision_to_schema(decision), dict(decision.timings_ms)
        else:
            from thinkgrasp.server.remote import ask_server

            model, timings_ms = ask_server(
                self.server, frame, self.instruction, self.stages, overlay=self.overlay, view=self.view
            )
        _print_decision(model, timings_ms, as_json=self.json)
        return DONE if model.status == "grasp" else NOTHING


@dataclass(frozen=True)
class DemoCommand:
    """Clear a simulated table until the goal is in the bin; record, film and report the episode."""

    instruction: Annotated[Positional[str | None], arg(metavar="INSTRUCTION")] = None
    """What to take, for example "I need a fruit"; default: the task's own sentence, or that one."""
    task: Annotated[str | None, arg(metavar="NAME")] = None
    """A pile of the published benchmark, for example clutter-06-fruit or heavy-05-fruit_hard."""
    objects: Annotated[Path | None, arg(metavar="DIR")] = None
    """Your own objects, a folder with a model.urdf each; the instruction names one of them."""
    visibility: Literal["visible", "partly", "hidden"] | None = None
    """How much of the goal the camera sees at first; by default as the task says, or as it falls; "hidden" where
    nothing was asked for."""
    out: Path = Path("out/demo")
    """Folder for report.html, the video, every step's images and JSON, and config.json."""
    camera: Literal["l515", "d455"] = "l515"
    """Which sensor's field of view and depth noise."""
    size: Annotated[str, arg(metavar="WxH")] = "640x480"
    """Image size: 640x480, 320x240 or 224x224."""
    noise: bool = True
    """Depth as the sensor would measure it; --no-noise: exact."""
    video: bool = True
    """Film the episode."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Attempts at most."""
    arm_planner: Annotated[str, arg(metavar="NAME")] = "rrt_connect"
    """What finds the arm's paths: rrt_connect, or with the extra ompl RRTstar, BITstar, ..."""
    live: bool = False
    """Show the running episode in the browser."""
    port: Annotated[int, arg(metavar="PORT")] = 8080
    """Where --live listens, on this machine only."""
    json: bool = False
    """Print the episode as JSON."""
    stages: tyro.conf.OmitArgPrefixes[StageOptions] = DEFAULT_STAGES

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp.config import load_config
        from thinkgrasp.demo import DemoOptions, run_demo
        from thinkgrasp.loop import END_WORDS
        from thinkgrasp.sim.options import CameraOptions, parse_size

        if self.instruction is not None:
            _check_text(self.instruction)
        if self.steps is not None and self.steps < 1:
            raise ConfigError(f"--steps must be at least 1, got {self.steps}")
        if not 1 <= self.port <= 65535:
            raise ConfigError(f"--port must lie in 1 to 65535, got {self.port}")
        oracle = self.stages.preset == "oracle"
        config = configure(replace(self.stages, preset="offline") if oracle else self.stages)
        if oracle and any(getattr(config, s) != getattr(load_config("offline"), s) for s in ORACLE_STAGES):
            raise ConfigError(f"--preset oracle brings its own {', '.join(ORACLE_STAGES)}; leave their settings out")
        make_folder(self.out)
        options = DemoOptions(
            instruction=self.instruction,
            task=self.task,
            objects=self.objects,
            seed=config.seed,
            steps=self.steps,
            visibility=self.visibility,
            video=self.video,
            arm_planner=self.arm_planner,
            live_port=self.port if self.live else None,
        )
        camera = CameraOptions(self.camera, parse_size(self.size), self.noise)
        if oracle:
            _progress("the oracle preset reads the simulator's truth: names and masks are not perceived")
        episode = run_demo(options, self.stages.preset, config, camera, self.out, _progress)
        report = (self.out / "report.html").resolve()
        if self.json:
            print(_encodable(episode.to_json(indent=2)))
        else:
            words: dict[str, str] = {**END_WORDS}
            print(f"{'goal delivered' if episode.success else 'goal not delivered'}: {episode.instruction}")
            print(f"  goal      {episode.goal}")
            print(f"  preset    {episode.preset}")
            print(f"  steps     {episode.steps}")
            print(f"  end       {episode.end}: {words[episode.end]}")
            print(f"  report    {report}")
        _progress(f"open {report}")
        return DONE if episode.success else NOTHING


@dataclass(frozen=True)
class DoctorCommand:
    """Say what is installed, what each missing extra would enable, and whether a decision works here."""

    weights: bool = False
    """Also list all weights: where they are, and the command that gets those that are missing."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp import doctor

        healthy = doctor.report(sys.stdout, weights=self.weights)
        return DONE if healthy else NOTHING


@dataclass(frozen=True)
class PluginsCommand:
    """List the installed plug-ins by stage."""

    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp import registry

        for kind in registry.KINDS:
            points = registry.available(kind)
            print(f"{kind}:" + ("" if points else " none"))
            for name, point in points.items():
                source = point.dist.name if point.dist is not None else "unknown package"
                print(f"  {name:<18} {point.value}  [{source}]")
        return DONE


@dataclass(frozen=True)
class PresetsCommand:
    """List the presets and the stages that each of them runs."""

    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp.config import PRESET_NOTES, PRESETS, SIMULATION_PRESETS

        for name, config in PRESETS.items():
            print(f"{name}: {PRESET_NOTES.get(name, '')}")
            stages = {
                "scene": config.scene.name if config.scene else "none (strict mode)",
                "planner": config.planner.name,
                "segmenter": config.segmenter.name,
                "generator": config.generator.name,
                "checks": ", ".join(c.name for c in config.checks),
            }
            for stage, chosen in stages.items():
                print(f"  {stage:<10} {chosen}")
        for name, note in SIMULATION_PRESETS.items():
            print(f"{name}: {note}")
        return DONE


Command = (
    Annotated[GraspCommand, subcommand("grasp")]
    | Annotated[DemoCommand, subcommand("demo")]
    | Annotated[BenchCommand, subcommand("bench")]
    | Annotated[RunCommand, subcommand("run")]
    | Annotated[CalibrateCommand, subcommand("calibrate")]
    | Annotated[ServeCommand, subcommand("serve")]
    | Annotated[DoctorCommand, subcommand("doctor")]
    | Annotated[PluginsCommand, subcommand("plugins")]
    | Annotated[PresetsCommand, subcommand("presets")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code; never raises for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    if args == ["--version"]:
        print(f"thinkgrasp {__version__}")
        return DONE
    debug = "--debug" in args
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        command = _parse(args)
        if isinstance(command, int):
            return command
        code = command.run()
        sys.stdout.flush()
        return code
    except ThinkGraspError as error:
        return _fail(error, BAD_INPUT, one_line(error), debug=debug)
    except BrokenPipeError:
        # Whoever read our output has gone; keep the interpreter from complaining when it flushes at exit.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except MemoryError as error:
        return _fail(error, BAD_INPUT, "out of memory: the images are too large for this machine", debug=debug)
    except Exception as error:
        message = one_line(f"{type(error).__name__}: {error}")
        return _fail(error, BUG, f"{message} (this is a bug; --debug shows where)", debug=debug)


def _parse(args: list[str]) -> Command | int:
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                Command,  # type: ignore[arg-type]
                prog="thinkgrasp",
                description="An RGB-D frame and a sentence in, a 6-DoF two-finger grasp out.",
                args=args,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            return DONE
        raise ConfigError(_usage_message(errors.getvalue())) from None


def _usage_message(panel: str) -> str:
    """Turn tyro's boxed report into one line: without title, border, help texts (indented deeper) and pointers.

    The border is drawn with box characters, ASCII or spaces, as the terminal allows.
    """
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in panel.strip("\n").splitlines()[1:]]
    said = [line[1:].strip("│| ") for line in lines if not line[1:].startswith(9 * " ")]
    text = one_line(" ".join(line for line in said if line.strip("─-╰╯+ ")))
    text = re.split(r" ?(?:For full helptext|Argument helptext:)", text)[0]
    return f"{text or 'the command line cannot be read'} (see thinkgrasp --help)"


def _fail(error: BaseException, code: int, message: str, *, debug: bool) -> int:
    if debug:
        traceback.print_exception(error, file=sys.stderr)
    print(f"error: {message}", file=sys.stderr)
    return code


def _progress(text: str) -> None:
    print(one_line(text), file=sys.stderr)


def _check_text(instruction: str) -> None:
    from thinkgrasp.pipeline import check_instruction

    check_instruction(instruction)
    try:
        instruction.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"the instruction is no valid text: {error}") from error


def _check_outputs(overlay: Path | None, view: Path | None, inputs: Sequence[Path]) -> None:
    if overlay is not None:
        if overlay.suffix.lower() not in OVERLAY_SUFFIXES:
            raise InputError(f"--overlay {overlay} must end in {', '.join(OVERLAY_SUFFIXES)}")
        check_writable(overlay, "--overlay", inputs=inputs)
    if view is not None:
        if view.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--view {view} must end in .html")
        check_writable(view, "--view", inputs=inputs)


def _write_pictures(decision: Decision, gripper: Gripper, overlay: Path | None, view: Path | None) -> None:
    if overlay is not None:
        from thinkgrasp.viz.overlay import draw_overlay

        buffer = io.BytesIO()
        draw_overlay(decision, gripper).convert("RGB").save(buffer, OVERLAY_SUFFIXES[overlay.suffix.lower()])
        write_atomic(overlay, buffer.getvalue())
    if view is not None:
        import tempfile

        from thinkgrasp.viz.view import write_view

        with tempfile.TemporaryDirectory() as folder:
            draft = Path(folder) / "view.html"
            write_view(decision, gripper, draft)
            write_atomic(view, draft.read_bytes())


def _print_decision(model: DecisionModel, timings_ms: dict[str, float], *, as_json: bool) -> None:
    if as_json:
        print(_encodable(model.to_json(indent=2)))
        return
    from thinkgrasp.summary import print_summary

    print_summary(model, timings_ms, sys.stdout)


def _encodable(text: str) -> str:
    """Return JSON text as it is, or with escapes where stdout's encoding lacks a character."""
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        import json

        return json.dumps(json.loads(text), indent=2)
    return text


if __name__ == "__main__":
    sys.exit(main())
