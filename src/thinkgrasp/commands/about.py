"""`thinkgrasp doctor`, `plugins` and `presets`: what is here."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from thinkgrasp.commands.terminal import DONE, NOTHING


@dataclass(frozen=True)
class DoctorCommand:
    """Say what is installed, what each missing extra would enable, and whether a decision works here."""

    weights: bool = False
    """Also list all weights: where they are, and the command that gets those that are missing."""
    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp import doctor

        healthy = doctor.report(sys.stdout, weights=self.weights)
        return DONE if healthy else NOTHING


@dataclass(frozen=True)
class PluginsCommand:
    """List the installed plug-ins by stage."""

    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp import registry

        for kind in registry.KINDS:
            points = registry.available(kind)
            print(f"{kind}:" + ("" if points else " none"))
            for name, point in points.items():
                source = point.dist.name if point.dist is not None else "unknown package"
                print(f"  {name:<18} {point.value}  [{source}]")
        return DONE


@dataclass(frozen=True)
class PresetsCommand:
    """List the presets and the stages that each of them runs."""

    debug: bool = False
    """Show the traceback of an error."""

    def run(self) -> int:
        """Carry the command out and return the exit code."""
        from thinkgrasp.config import PRESET_NOTES, PRESETS, SIMULATION_PRESETS

        for name, config in PRESETS.items():
            print(f"{name}: {PRESET_NOTES.get(name, '')}")
            stages = {
                "scene": config.scene.name if config.scene else "none (strict mode)",
                "planner": config.planner.name,
                "segmenter": config.segmenter.name,
                "generator": config.generator.name,
                "checks": ", ".join(c.name for c in config.checks),
            }
            for stage, chosen in stages.items():
                print(f"  {stage:<10} {chosen}")
        for name, note in SIMULATION_PRESETS.items():
            print(f"{name}: {note}")
        return DONE
