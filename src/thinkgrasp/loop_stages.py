"""A pipeline's configuration as the closed loop runs it, simulated or real."""

from __future__ import annotations

from dataclasses import replace

from thinkgrasp.config import PipelineConfig, StageConfig


def for_the_loop(config: PipelineConfig) -> PipelineConfig:
    """Return a configuration as the loop runs it.

    Only what the arm reaches is chosen; fingers may touch the table's noise, since the robot feels a contact; and a
    planner of ours goes on clearing while the goal is not in view. Settings that were made stay.
    """
    checks = [_with_default(c, "support_noise_m", 0.003) if c.name == "collision" else c for c in config.checks]
    if all(c.name != "reach" for c in checks):
        checks.append(StageConfig("reach"))
    planner, generator = config.planner, config.generator
    if planner.name in ("offline", "openai"):
        planner = _with_default(planner, "search", "all")
    if generator.name in ("antipodal", "vgn", "vgn_antipodal"):
        generator = _with_default(generator, "tip_height_m", 0.0035)
    return replace(config, planner=planner, generator=generator, checks=tuple(checks))


def _with_default(stage: StageConfig, key: str, value: object) -> StageConfig:
    return stage if key in stage.settings else stage.with_setting(key, value)
