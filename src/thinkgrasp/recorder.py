"""Keep an episode on disk, step by step, so that a process killed at any moment leaves all finished steps readable."""

from __future__ import annotations

import errno
import io
import os
import shutil
import time
from pathlib import Path

from PIL import Image

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.episode import (
    EPISODE_FILE,
    HEADER_FILE,
    LOG_FILE,
    REPORT_FILE,
    STEPS_FOLDER,
    VIDEO_FILE,
    EpisodeHeader,
    EpisodeModel,
    StepLine,
    assemble_episode,
    outcome_to_schema,
    read_episode,
    scene_to_schema,
    step_folder,
)
from thinkgrasp.errors import InputError
from thinkgrasp.gripper import Gripper
from thinkgrasp.outputs import make_folder, write_atomic
from thinkgrasp.schema import decision_to_schema
from thinkgrasp.types import Decision, Outcome, Usage
from thinkgrasp.viz.overlay import draw_overlay
from thinkgrasp.viz.panel import render_panel
from thinkgrasp.viz.report import write_report


class EpisodeRecorder:
    """Write each step's files, then its line in episode.jsonl, then the report; nothing but the lines stays in memory.

    A step's folder is written under another name and renamed when it is complete. An earlier recording in the same
    folder is replaced.

    Args:
        folder: Where to record; made if needed. The layout is that of `thinkgrasp.episode`.
        header: What was asked.
        gripper: Geometry of the gripper to draw.

    Raises:
        InputError: The folder cannot be used, or holds a `steps` folder that no recorder wrote.
    """

    def __init__(self, folder: str | Path, *, header: EpisodeHeader, gripper: Gripper) -> None:
        self._folder = Path(folder)
        self._header = header
        self._gripper = gripper
        self._lines: list[StepLine] = []
        self._since = time.monotonic()
        make_folder(self._folder)
        _clear(self._folder)
        write_atomic(self._folder / HEADER_FILE, header.to_json(indent=2).encode())
        (self._folder / STEPS_FOLDER).mkdir()

    @property
    def folder(self) -> Path:
        """Where the episode is recorded."""
        return self._folder

    def record(self, decision: Decision, outcome: Outcome | None) -> None:
        """Keep one step; durable when the call returns.

        Raises:
            InputError: The disk cannot be written.
        """
        step = len(self._lines) + 1
        duration_s = time.monotonic() - self._since
        published = decision_to_schema(decision)
        line = StepLine(
            step=step,
            status=decision.status,
            role=decision.plan.role,
            target=decision.plan.target,
            mark=decision.plan.mark,
            cell=decision.plan.cell,
            outcome=outcome_to_schema(outcome),
            duration_s=round(duration_s, 3),
            timings_ms=published.timings_ms,
        )
        final = step_folder(self._folder, step)
        partial = final.with_name(f".{final.name}.partial")
        try:
            for left_over in (partial, final):
                shutil.rmtree(left_over, ignore_errors=True)
            partial.mkdir()
            save_frame(decision.scene.frame, partial)
            others = decision.scene.frame.others
            for number, frame in enumerate(others.frames if others is not None else (), 2):
                folder = partial / f"view{number}"
                folder.mkdir()
                save_frame(frame, folder)
            picture = draw_overlay(decision, self._gripper)
            panel = render_panel(
                step,
                decision,
                outcome,
                self._gripper,
                duration_s=duration_s,
                earlier=self._lines,
                picture=picture,
            )
            files = {
                "decision.json": published.to_json(indent=2).encode(),
                "scene.json": scene_to_schema(decision.scene).to_json(indent=2).encode(),
                "outcome.json": b"null" if line.outcome is None else line.outcome.to_json(indent=2).encode(),
                "overlay.png": _png(picture),
                "panel.html": panel.encode("utf-8", "replace"),
            }
            for name, data in files.items():
                (partial / name).write_bytes(data)
            for path in (*partial.rglob("*"), partial):
                _sync(path)
            partial.rename(final)
            _sync(final.parent)
            _append(self._folder / LOG_FILE, line.to_json().encode() + b"\n")
        except OSError as error:
            raise InputError(f"step {step} cannot be recorded in {self._folder}: {error.strerror or error}") from error
        self._lines.append(line)
        self._since = time.monotonic()
        write_report(self._folder)

    def finish(self, *, end: str, success: bool, usage: Usage) -> EpisodeModel:
        """Write episode.json and the final report, and return what episode.json holds.

        Args:
            end: Named reason why the episode ended.
            success: Whether the goal was reached.
            usage: What all decisions cost.

        Raises:
            InputError: The disk cannot be written.
        """
        steps = read_episode(self._folder).steps
        episode = assemble_episode(
            ((step.decision(), step.line.outcome) for step in steps),
            header=self._header,
            end=end,
            success=success,
            out=self._folder,
            usage=usage,
        )
        write_atomic(self._folder / EPISODE_FILE, episode.to_json(indent=2).encode())
        write_report(self._folder)
        return episode


def _clear(folder: Path) -> None:
    """Remove an earlier recording, and only that."""
    steps = folder / STEPS_FOLDER
    if steps.exists() and not (folder / HEADER_FILE).is_file():
        raise InputError(f"{steps} was not written by a recorder; record into another folder")
    try:
        for name in (EPISODE_FILE, LOG_FILE, REPORT_FILE, VIDEO_FILE):
            (folder / name).unlink(missing_ok=True)
        if steps.exists():
            shutil.rmtree(steps)
        (folder / HEADER_FILE).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"the earlier recording in {folder} cannot be replaced: {error.strerror or error}") from error


def _append(path: Path, data: bytes) -> None:
    """Add to a file, all or nothing, and wait until it is on the disk."""
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    size = os.fstat(handle).st_size
    try:
        if os.write(handle, data) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(handle)
    except OSError:
        os.ftruncate(handle, size)
        raise
    finally:
        os.close(handle)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=3)
    return buffer.getvalue()
