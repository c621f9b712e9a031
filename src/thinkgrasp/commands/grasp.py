"""`thinkgrasp grasp`: one frame and a sentence in, a grasp out."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from thinkgrasp.commands.stages import DEFAULT_STAGES, StageOptions, configure
from thinkgrasp.commands.terminal import DONE, NOTHING, check_text, encodable, progress
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.outputs import OVERLAY_SUFFIXES, check_writable, write_atomic

if TYPE_CHECKING:
    from thinkgrasp.gripper import Gripper
    from thinkgrasp.schema import DecisionModel
    from thinkgrasp.types import Decision


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

        check_text(self.instruction)
        config = configure(self.stages)
        frame = load_frame(
            self.color, self.depth, self.camera, depth_scale=self.depth_scale, workspace_mask=self.workspace_mask
        )
        if self.also and self.server is not None:
            raise ConfigError("--also needs a decision here: the server takes one view; leave out --server")
        if self.also:
            from thinkgrasp.fusion import describe, fuse

            frame = fuse([frame, *(load_frame(*view, depth_scale=self.depth_scale) for view in self.also)])
            progress(describe(frame))
        if self.server is None:
            from thinkgrasp.schema import decision_to_schema

            pipeline = make_pipeline(config)
            decision = pipeline.decide(frame, self.instruction)
            _write_pictures(decision, pipeline.gripper, self.overlay, self.view)
            model, timings_ms = decision_to_schema(decision), dict(decision.timings_ms)
        else:
            from thinkgrasp.commands.remote import ask_server

            model, timings_ms = ask_server(
                self.server, frame, self.instruction, self.stages, overlay=self.overlay, view=self.view
            )
        _print_decision(model, timings_ms, as_json=self.json)
        return DONE if model.status == "grasp" else NOTHING


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
        print(encodable(model.to_json(indent=2)))
        return
    from thinkgrasp.commands.summary import print_summary

    print_summary(model, timings_ms, sys.stdout)
