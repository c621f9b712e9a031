"""`thinkgrasp run`: the closed loop on a real robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from thinkgrasp.commands.stages import DEFAULT_STAGES, StageOptions, configure
from thinkgrasp.commands.terminal import DONE, NOTHING, check_text, encodable, progress
from thinkgrasp.errors import ConfigError
from thinkgrasp.outputs import make_folder


@dataclass(frozen=True)
class RunCommand:
    """Clear a real table until the goal is in the bin. THE ROBOT MOVES: read docs/real_robot.md first."""

    instruction: Annotated[Positional[str], arg(metavar="INSTRUCTION")]
    """What to take, for example "give me the mug"."""
    robot: Annotated[str, arg(metavar="NAME")] = "ur"
    """Robot plug-in (see `thinkgrasp plugins`)."""
    camera: Annotated[str, arg(metavar="NAME")] = "realsense"
    """Camera plug-in."""
    cell: Annotated[Path | None, arg(metavar="FILE")] = None
    """The cell: addresses, base, workspace, bin, limits, camera file. Needed by the robot "ur"."""
    dry_run: bool = False
    """Look, plan and show; nothing moves."""
    confirm: bool = True
    """Ask before each motion; --no-confirm: nobody is asked."""
    speed: Annotated[float, arg(metavar="SHARE")] = 1.0
    """Share of the cell's speed limits, up to 1."""
    steps: Annotated[int, arg(metavar="N")] = 15
    """Attempts at most."""
    out: Path = Path("out/run")
    """Folder for report.html, every step's images and JSON, robot.jsonl and config.json."""
    arm_planner: Annotated[str, arg(metavar="NAME")] = "rrt_connect"
    """What finds the arm's paths: rrt_connect, or with the extra ompl RRTstar, BITstar, ..."""
    robot_set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE")] = ()
    """One setting of the robot plug-in."""
    camera_set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE")] = ()
    """One setting of the camera plug-in, over those of the cell file."""
    json: bool = False
    """Print the episode as JSON."""
    stages: tyro.conf.OmitArgPrefixes[StageOptions] = DEFAULT_STAGES

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp.config import parse_assignment
        from thinkgrasp.lab.person import Absent, AtTheKeyboard
        from thinkgrasp.loop import END_WORDS
        from thinkgrasp.run import RunOptions, run_on_robot

        instruction = check_text(self.instruction)
        if self.steps < 1:
            raise ConfigError(f"--steps must be at least 1, got {self.steps}")
        if not 0 < self.speed <= 1:
            raise ConfigError(
                f"--speed is a share of the cell's limits and must lie in (0, 1], got {self.speed:g}; "
                "limits are raised in "
                "the cell file only"
            )
        config = configure(self.stages)
        make_folder(self.out)
        options = RunOptions(
            instruction=instruction,
            robot=self.robot,
            camera=self.camera,
            cell=self.cell,
            dry_run=self.dry_run,
            speed=self.speed,
            steps=self.steps,
            arm_planner=self.arm_planner,
            robot_settings=dict(parse_assignment(text, "--robot-set") for text in self.robot_set),
            camera_settings=dict(parse_assignment(text, "--camera-set") for text in self.camera_set),
        )
        person = AtTheKeyboard() if self.confirm else Absent()
        result = run_on_robot(options, self.stages.preset, config, person, self.out, progress)
        episode = result.episode
        report = (self.out / "report.html").resolve()
        planned = any(o is not None and o.reason == "dry_run" for o in episode.outcomes)
        if self.json:
            print(encodable(episode.to_json(indent=2)))
        else:
            words: dict[str, str] = {**END_WORDS}
            said = "goal delivered" if episode.success else "a motion was planned" if planned else "goal not delivered"
            print(f"{said}: {episode.instruction}")
            print(f"  preset    {episode.preset}")
            print(f"  steps     {episode.steps}")
            print(f"  end       {'dry_run' if planned else f'{episode.end}: {words[episode.end]}'}")
            if result.halted is not None:
                print(f"  robot     stands still: {result.halted}")
            print(f"  report    {report}")
        if result.halted is not None:
            progress(f"the robot stands still ({result.halted.replace('_', ' ')}); look at it before the next run")
        return DONE if episode.success or planned else NOTHING
