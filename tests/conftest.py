"""Fixtures shared by all tests: small frames, frames as files, and the command line run in this process."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fakes.frames import FrameFiles
from fakes.stages import camera_dict, fake_pipeline, table_frame
from hypothesis import settings
from PIL import Image

from thinkgrasp.pipeline import Pipeline
from thinkgrasp.types import Frame

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the tests run side by side: threads would wait for one another

settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=60)
settings.load_profile("repeatable")


@dataclass(frozen=True)
class CliResult:
    code: int
    out: str
    err: str


@pytest.fixture
def frame() -> Frame:
    return table_frame()


@pytest.fixture
def pipeline() -> Pipeline:
    return fake_pipeline()


@pytest.fixture
def frame_files(tmp_path: Path, frame: Frame) -> FrameFiles:
    """A 64x48 frame: 8-bit RGB, 16-bit millimetres, and its camera."""
    color, depth, camera = tmp_path / "color.png", tmp_path / "depth.png", tmp_path / "camera.json"
    Image.fromarray(frame.color).save(color)
    Image.fromarray(np.rint(frame.depth * 1000).astype(np.uint16)).save(depth)
    camera.write_text(json.dumps(camera_dict()))
    return FrameFiles(color, depth, camera)


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Callable[..., CliResult]:
    """Run the command line in this process."""
    from thinkgrasp.cli import main

    def run(*args: str) -> CliResult:
        capsys.readouterr()
        code = main(list(args))
        captured = capsys.readouterr()
        return CliResult(code, captured.out, captured.err)

    return run
