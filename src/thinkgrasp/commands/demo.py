"""`thinkgrasp demo`: an episode in the simulator, recorded, filmed and reported."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from thinkgrasp.commands.stages import DEFAULT_STAGES, StageOptions, configure
from thinkgrasp.commands.terminal import DONE, NOTHING, check_text, encodable, progress
from thinkgrasp.errors import ConfigError
from thinkgrasp.outputs import make_folder

ORACLE_STAGES = ("scene", "planner", "segmenter")
"""Replaced by the simulator's truth, so that settings of theirs would do nothing."""


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
            check_text(self.instruction)
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
            progress("the oracle preset reads the simulator's truth: names and masks are not perceived")
        episode = run_demo(options, self.stages.preset, config, camera, self.out, progress)
        report = (self.out / "report.html").resolve()
        if self.json:
            print(encodable(episode.to_json(indent=2)))
        else:
            words: dict[str, str] = {**END_WORDS}
            print(f"{'goal delivered' if episode.success else 'goal not delivered'}: {episode.instruction}")
            print(f"  goal      {episode.goal}")
            print(f"  preset    {episode.preset}")
            print(f"  steps     {episode.steps}")
            print(f"  end       {episode.end}: {words[episode.end]}")
            print(f"  report    {report}")
        progress(f"open {report}")
        return DONE if episode.success else NOTHING
