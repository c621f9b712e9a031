"""What a benchmark runs: everything that is needed to run it again, as benchmark.json in its folder."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from thinkgrasp import __version__
from thinkgrasp.benchmark.methods import Method, Variant
from thinkgrasp.benchmark.suites import SuiteSource
from thinkgrasp.config import from_json, to_json
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.outputs import write_atomic
from thinkgrasp.sim.options import CameraOptions

PLAN_FILE = "benchmark.json"
PACKAGES = ("numpy", "scipy", "mujoco-core", "pillow", "pydantic", "openai", "torch", "ray")
"""Those of which results or times may depend on the version."""


class Versions(BaseModel):
    """What the results depend on beside the plan."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    thinkgrasp: str
    source: str
    """Digest of the package's code."""
    python: str
    machine: str
    packages: dict[str, str]

    @classmethod
    def here(cls) -> Versions:
        """Return those of this process."""
        found: dict[str, str] = {}
        for name in PACKAGES:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        machine = f"{platform.system()} {platform.machine()}"
        return cls(
            thinkgrasp=__version__, source=_digest(), python=platform.python_version(), machine=machine, packages=found
        )


class Session(BaseModel):
    """One start of the benchmark."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    started: datetime
    versions: Versions


class _MethodModel(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    variant: Variant = ""
    accuracy: float | None = None
    truth: bool = False
    config: dict[str, object]


class _PlanModel(BaseModel):
    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    schema_: Annotated[Literal["thinkgrasp/benchmark-1"], Field(alias="schema")] = "thinkgrasp/benchmark-1"
    suite: str
    cases: str | None
    objects: str | None
    tasks: list[str]
    first_seed: int
    runs: int
    camera: str
    size_wh: tuple[int, int]
    noise: bool
    methods: list[_MethodModel]
    sessions: list[Session]


@dataclass(frozen=True)
class BenchmarkPlan:
    """Methods over the piles of a suite."""

    source: SuiteSource
    tasks: tuple[str, ...]
    """Names of the suite's cases that run, in its order."""
    first_seed: int
    runs: int
    """Piles per task; run n has the seed first_seed + n."""
    camera: CameraOptions
    methods: tuple[Method, ...]
    sessions: tuple[Session, ...] = ()

    @property
    def seeds(self) -> range:
        """Of the piles."""
        return range(self.first_seed, self.first_seed + self.runs)

    def started(self) -> BenchmarkPlan:
        """Return it with one more session, now."""
        now = datetime.now(UTC).replace(microsecond=0)
        return replace(self, sessions=(*self.sessions, Session(started=now, versions=Versions.here())))

    def merged(self, asked: BenchmarkPlan) -> BenchmarkPlan:
        """Return this plan, extended by the methods and runs of another one.

        Raises:
            ConfigError: They are of different piles, or a method of the same name is another one.
        """
        for what in ("source", "tasks", "first_seed", "camera"):
            mine, theirs = getattr(self, what), getattr(asked, what)
            if mine != theirs:
                raise ConfigError(
                    f"the folder holds a benchmark with {what.replace('source', 'suite')} {mine}, asked for is {theirs}"
                )
        known = {method.name: method for method in self.methods}
        for method in asked.methods:
            if known.setdefault(method.name, method) != method:
                raise ConfigError(f"the folder holds results of another method {method.name!r}")
        return replace(self, methods=tuple(known.values()), runs=max(self.runs, asked.runs))

    def write(self, folder: Path) -> None:
        """Write benchmark.json.

        Raises:
            InputError: It cannot be written.
        """
        model = _PlanModel(
            suite=self.source.name,
            cases=None if self.source.cases is None else str(self.source.cases.resolve()),
            objects=None if self.source.objects is None else str(self.source.objects.resolve()),
            tasks=list(self.tasks),
            first_seed=self.first_seed,
            runs=self.runs,
            camera=self.camera.model,
            size_wh=self.camera.size_wh,
            noise=self.camera.noise,
            methods=[
                _MethodModel(
                    name=m.name, variant=m.variant, accuracy=m.accuracy, truth=m.truth,
                    config=json.loads(to_json(m.config)),
                )
                for m in self.methods
            ],
            sessions=list(self.sessions),
        )  # fmt: skip
        write_atomic(folder / PLAN_FILE, model.model_dump_json(by_alias=True, indent=2).encode() + b"\n")


def read_plan(path: Path) -> BenchmarkPlan:
    """Read a folder's benchmark.json, or such a file by its own name.

    Raises:
        InputError: It is not there, or no plan.
    """
    path = path / PLAN_FILE if path.is_dir() else path
    try:
        model = _PlanModel.model_validate_json(path.read_bytes())
        methods = tuple(
            Method(m.name, from_json(json.dumps(m.config)), m.variant, m.accuracy, m.truth) for m in model.methods
        )
        source = SuiteSource(model.suite, _path(model.cases), _path(model.objects))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the folder of a benchmark") from error
    except (ValidationError, ConfigError) as error:
        reason = error if isinstance(error, ConfigError) else error.errors()[0]["msg"]
        raise InputError(f"{path}: is no plan of a benchmark: {reason}") from error
    return BenchmarkPlan(
        source,
        tuple(model.tasks),
        model.first_seed,
        model.runs,
        CameraOptions(model.camera, model.size_wh, model.noise),
        methods,
        tuple(model.sessions),
    )


def different_sources(sessions: Sequence[Session]) -> tuple[str, ...]:
    """Return the digests of the code that results come from, oldest first."""
    return tuple(dict.fromkeys(session.versions.source for session in sessions))


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


def _digest() -> str:
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*")):
        if file.suffix in (".py", ".toml"):
            digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]
