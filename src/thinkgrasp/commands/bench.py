"""`thinkgrasp bench`: run a benchmark, report on it, compare two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, arg, subcommand

from thinkgrasp.commands.terminal import DONE, NOTHING, progress
from thinkgrasp.errors import ConfigError, InputError, MissingDependency
from thinkgrasp.outputs import make_folder

if TYPE_CHECKING:
    from thinkgrasp.benchmark.plan import BenchmarkPlan


@dataclass(frozen=True)
class BenchRun:
    """Run methods over the seeded piles of a suite; the same command goes on where it was cut off."""

    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the results; with nothing but --out, what it holds goes on."""
    suite: Annotated[str | None, arg(metavar="NAME")] = None
    """clutter (clutter-v1), heavy (heavy-v1), paper-clutter or paper-heavy."""
    preset: Annotated[tuple[str, ...], arg(metavar="METHOD ...")] = ()
    """What runs, by default offline: presets, oracle, no-memory, no-graph, random-object, nearest-grasp, best-score,
    configurations (FILE.json), your own plug-ins (planner=NAME); vlm@0.8 asks an emulated model that is right so often,
    offline+truth perceives by the simulator's truth."""
    runs: Annotated[int, arg(metavar="N")] = 15
    """Piles per task."""
    first_seed: Annotated[int | None, arg(metavar="N")] = None
    """Of the first pile (1000)."""
    tasks: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    """Only these tasks of the suite."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Processes on this machine."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Run on a Ray cluster instead: HOST:PORT, auto, or local."""
    cases: Annotated[Path | None, arg(metavar="DIR")] = None
    """The published layouts, for the paper- suites."""
    objects: Annotated[Path | None, arg(metavar="DIR")] = None
    """The published objects, one folder each with a model.urdf, named by their published ids; else stand-ins."""
    camera: Annotated[str, arg(metavar="NAME")] = "l515"
    """Sensor: l515 or d455."""
    size: Annotated[str, arg(metavar="WxH")] = "640x480"
    """Image size."""
    noise: bool = True
    """Depth as the sensor would measure it; --no-noise: exact."""
    again: Annotated[Path | None, arg(metavar="DIR")] = None
    """Run the benchmark of this folder once more, into --out."""
    retry_crashed: bool = False
    """Run episodes again that crashed or had no pile."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code: 0 all episodes ran, 1 some crashed or had no pile."""
        if self.workers < 1 or self.runs < 1:
            raise ConfigError(f"--workers and --runs must be at least 1, got {self.workers} and {self.runs}")
        if self.ray is not None and self.workers != 1:
            raise ConfigError("--ray uses the cluster's own workers; leave out --workers")
        _check_simulator()
        from thinkgrasp.benchmark.records import CRASHED, NO_SCENE
        from thinkgrasp.benchmark.report import write_report
        from thinkgrasp.benchmark.runner import local_workers, run_benchmark

        plan = self._plan()
        if self.ray is not None:
            from thinkgrasp.benchmark.ray_runner import ray_workers

            source = ray_workers(self.ray)
        else:
            source = local_workers(self.workers)
        make_folder(self.out)
        records = run_benchmark(plan, self.out, source, progress, retry_crashed=self.retry_crashed)
        print(write_report((self.out,)))
        broken = sum(episode.end in (CRASHED, NO_SCENE) for episode in records.episodes.values())
        return NOTHING if broken else DONE

    def _plan(self) -> BenchmarkPlan:
        from thinkgrasp.benchmark.plan import PLAN_FILE, read_plan

        if self.again is not None:
            if self.suite or self.preset:
                raise ConfigError("--again takes everything from its folder; leave out --suite and --preset")
            if (self.out / PLAN_FILE).exists() and self.out.samefile(self.again):
                raise ConfigError("--again and --out are one folder; without --again, --out goes on where it was cut")
            return replace(read_plan(self.again), sessions=())
        if self.suite is None:
            if not (self.out / PLAN_FILE).exists():
                raise ConfigError(f"{self.out} holds no benchmark yet: add --suite (clutter, heavy, ...)")
            if self.preset:
                raise ConfigError("--preset needs --suite too")
            return read_plan(self.out)
        return self._asked(self.suite)

    def _asked(self, suite: str) -> BenchmarkPlan:
        from thinkgrasp.benchmark.methods import parse_method
        from thinkgrasp.benchmark.plan import BenchmarkPlan
        from thinkgrasp.benchmark.suites import ALIASES, FIRST_SEED, SuiteSource, load_suite
        from thinkgrasp.sim.options import CameraOptions, parse_size
        from thinkgrasp.sim.views import default_view

        cases, objects = (folder and folder.expanduser().resolve() for folder in (self.cases, self.objects))
        source = SuiteSource(ALIASES.get(suite, suite), cases, objects)
        names = [case.name for case in load_suite(source)]
        if strange := sorted(set(self.tasks) - set(names)):
            raise ConfigError(f"suite {source.name} has no task {strange[0]!r}; it has {', '.join(names)}")
        chosen = tuple(name for name in names if name in self.tasks or not self.tasks)
        methods = tuple(parse_method(name) for name in dict.fromkeys(self.preset or ("offline",)))
        camera = CameraOptions(self.camera, parse_size(self.size), self.noise)
        default_view(camera.model, camera.size_wh)
        first = FIRST_SEED if self.first_seed is None else self.first_seed
        if first < 0:
            raise ConfigError(f"--first-seed must not be negative, got {first}")
        return BenchmarkPlan(source, chosen, first, self.runs, camera, methods)


@dataclass(frozen=True)
class BenchReport:
    """Write report.md, report.html and rows.tex from the results of one or several folders."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR ...", help_behavior_hint="(required)")]
    """Folders of `bench run`; the report is written into the first."""
    reference: Annotated[str | None, arg(metavar="METHOD")] = None
    """The method that the others are tested against; by default the first."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        _check_simulator()
        from thinkgrasp.benchmark.report import write_report

        if not self.folders:
            raise InputError("bench report needs the folder of a benchmark")
        print(write_report(self.folders, self.reference))
        return DONE


@dataclass(frozen=True)
class BenchCompare:
    """Compare two result folders, episode by episode where they share methods and piles."""

    a: Annotated[Positional[Path], arg(metavar="A")]
    """Folder of `bench run`."""
    b: Annotated[Positional[Path], arg(metavar="B")]
    """Another one, whose results are set against those of A."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        _check_simulator()
        from thinkgrasp.benchmark.comparison import compare

        print(compare(self.a, self.b))
        return DONE


@dataclass(frozen=True)
class BenchCommand:
    """The benchmark: run methods over suites of seeded piles, report, compare."""

    command: OmitArgPrefixes[
        OmitSubcommandPrefixes[
            Annotated[BenchRun, subcommand("run")]
            | Annotated[BenchReport, subcommand("report")]
            | Annotated[BenchCompare, subcommand("compare")]
        ]
    ]

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        return self.command.run()


def _check_simulator() -> None:
    """Raise MissingDependency where there is no simulator: everything of the benchmark needs it."""
    try:
        import mujoco  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingDependency("mujoco-core", "sim", "the benchmark") from error
