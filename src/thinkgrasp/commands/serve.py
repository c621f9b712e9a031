"""`thinkgrasp serve`: decisions over HTTP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import UseAppendAction, arg

from thinkgrasp.commands.stages import ASK_NOTHING, DEFAULT_STAGES, StageOptions, configure
from thinkgrasp.commands.terminal import DONE, progress
from thinkgrasp.errors import ConfigError, MissingDependency


@dataclass(frozen=True)
class ServeCommand:
    """Answer requests over HTTP: decisions, episodes, the paper's own interface, and a page to try it."""

    host: str = "127.0.0.1"
    """Address to listen at; any but this machine's own needs a token (THINKGRASP_TOKEN or --token-file)."""
    port: Annotated[int, arg(metavar="PORT")] = 8000
    """Port to listen at; 0 = any that is free."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Processes that decide, each with its models; 0 = in the server's process, where a stage cannot be ended."""
    token_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """File with the token that clients have to send; goes before THINKGRASP_TOKEN."""
    queue: Annotated[int, arg(metavar="N")] = 8
    """Requests that may wait for a worker; one more is answered with 429."""
    max_megapixels: Annotated[float, arg(metavar="MP")] = 8
    """Largest image, by its header."""
    max_body_mb: Annotated[float, arg(metavar="MB")] = 48
    """Largest request."""
    stage_timeout: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="STAGE=SECONDS")] = ()
    """Time limit of a stage, for example plan=30; stages: decode, scene, plan, segment, generate, check, pictures,
    total."""
    episode_ttl: Annotated[float, arg(metavar="SECONDS")] = 900
    """An episode without a request for so long is forgotten."""
    recycle_after: Annotated[int, arg(metavar="N")] = 0
    """Start a worker's process anew after so many decisions; 0 = never."""
    paper_root: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder whose files /grasp_pose may read by path; without it, it takes uploads only."""
    paper_camera: Annotated[Path | None, arg(metavar="FILE")] = None
    """Camera file for requests to /grasp_pose that bring none."""
    stages: tyro.conf.OmitArgPrefixes[StageOptions] = DEFAULT_STAGES

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        try:
            from thinkgrasp.server.access import read_token
            from thinkgrasp.server.app import ServerOptions
            from thinkgrasp.server.limits import STAGE_TIMEOUTS_S, Limits
            from thinkgrasp.server.paper_api import PaperOptions
            from thinkgrasp.server.serving import serve
            from thinkgrasp.server.workers import Recipe
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] == "thinkgrasp":
                raise
            raise MissingDependency(error.name or "fastapi", "server", "the HTTP server") from None

        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--port must lie in 0 to 65535, got {self.port}")
        if not 0 <= self.workers <= 64:
            raise ConfigError(f"--workers must lie in 0 to 64, got {self.workers}")
        if self.recycle_after < 0:
            raise ConfigError(f"--recycle-after must be at least 0, got {self.recycle_after}")
        config = configure(self.stages)
        if config.planner.name not in ASK_NOTHING and config.planner.settings.get("record") and self.workers > 1:
            raise ConfigError("--record needs --workers 1: only one process may write to a cassette")
        if self.paper_root is not None and not self.paper_root.is_dir():
            raise ConfigError(f"--paper-root {self.paper_root} is not a folder")
        limits = Limits(
            body_mb=self.max_body_mb,
            megapixels=self.max_megapixels,
            queue=self.queue,
            episode_ttl_s=self.episode_ttl,
            stage_timeouts_s={**STAGE_TIMEOUTS_S, **dict(map(_timeout, self.stage_timeout))},
        )
        options = ServerOptions(
            workers=self.workers,
            limits=limits,
            token=read_token(self.token_file),
            paper=PaperOptions(self.paper_root, None if self.paper_camera is None else _camera(self.paper_camera)),
            recycle_after=self.recycle_after,
            debug=self.stages.debug,
        )
        recipe = Recipe(config, limits.pixels, debug=self.stages.debug)
        serve(recipe, options, host=self.host, port=self.port, on_listening=self._say)
        return DONE

    def _say(self, url: str) -> None:
        progress(f"thinkgrasp serves preset {self.stages.preset} at {url} (interface: {url}/docs)")


def _timeout(text: str) -> tuple[str, float]:
    stage, equals, seconds = text.partition("=")
    try:
        return stage, float(seconds if equals else "")
    except ValueError:
        raise ConfigError(f"--stage-timeout takes STAGE=SECONDS, for example plan=30, got {text!r}") from None


def _camera(path: Path) -> bytes:
    """Return a camera file as the server's own JSON; raises InputError where it cannot be used."""
    import json

    from thinkgrasp.cameras.calibration import read_calibration

    found = read_calibration(path)
    camera: dict[str, object] = {name: getattr(found, name) for name in ("fx", "fy", "cx", "cy")}
    if found.size_wh is not None:
        camera["width"], camera["height"] = found.size_wh
    if found.depth_scale is not None:
        camera["depth_scale"] = found.depth_scale
    return json.dumps(camera).encode()
