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
from typing import Annotated

import tyro
from tyro.conf import subcommand

from thinkgrasp import __version__
from thinkgrasp.commands.about import DoctorCommand, PluginsCommand, PresetsCommand
from thinkgrasp.commands.bench import BenchCommand
from thinkgrasp.commands.calibrate import CalibrateCommand
from thinkgrasp.commands.demo import DemoCommand
from thinkgrasp.commands.grasp import GraspCommand
from thinkgrasp.commands.run import RunCommand
from thinkgrasp.commands.serve import ServeCommand
from thinkgrasp.commands.terminal import BAD_INPUT, BUG, DONE, INTERRUPTED
from thinkgrasp.errors import ConfigError, ThinkGraspError
from thinkgrasp.outputs import one_line

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


if __name__ == "__main__":
    sys.exit(main())
