"""Stages that do what the instruction orders, such as "red sleep" or "red crash"; light, as workers import them."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import replace

from fakes.stages import FakePlanner, fake_pipeline

from thinkgrasp.config import PipelineConfig
from thinkgrasp.pipeline import Pipeline
from thinkgrasp.types import Usage


def told_pipeline(config: PipelineConfig) -> Pipeline:
    """Stages of `fakes.stages` with a planner that does what it is told."""
    orders = dict(config.planner.settings)
    return fake_pipeline(planner=ToldPlanner(**orders))


def broken_pipeline(config: PipelineConfig) -> Pipeline:
    """Fails as a plug-in may while it is made."""
    raise RuntimeError("CUDA is out of memory at /secret/place")


class ToldPlanner(FakePlanner):
    def __init__(self, sleep_s: float = 30.0, usd: float = 0.0) -> None:
        super().__init__()
        self.sleep_s = sleep_s
        self.usd = usd

    def plan(self, scene, instruction, memory):
        if "nap" in instruction:
            time.sleep(0.3)
        if "sleep" in instruction:
            time.sleep(self.sleep_s)
        if "loud" in instruction:
            os.write(2, b"/secret/place/of/libtiff: error\n")
            print("/secret/place/of/weights")
            logging.getLogger("library").warning("/secret/place/weights.pth is old")
        if "crash" in instruction:
            os._exit(11)
        if "bug" in instruction:
            raise ZeroDivisionError("/secret/path/weights.pth has the key sk-1234567890")
        plan = super().plan(scene, instruction, memory)
        return replace(plan, usage=Usage("told", 10, 5, self.usd, 1, 0.1))
