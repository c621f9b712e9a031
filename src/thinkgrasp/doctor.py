"""What is installed here, what each missing extra would enable, and whether a decision works."""

from __future__ import annotations

import platform
import re
import sys
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import TextIO

from thinkgrasp import __version__, registry
from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.networks.torch_install import CURE, torchvision_problem
from thinkgrasp.weights import known_weights

SELF_CHECK_INSTRUCTION = "the red box"


@dataclass(frozen=True)
class Extra:
    """An optional group of packages; `in_use` is False while no part of this version needs it."""

    purpose: str
    in_use: bool


EXTRAS: dict[str, Extra] = {
    "sim": Extra("closed-loop episodes in the MuJoCo simulator", True),
    "convex": Extra("convex pieces for your own objects whose collision mesh is not convex", True),
    "egl": Extra("rendering simulated frames on a GPU", True),
    "vlm": Extra("planning with GPT-4o or any server that speaks chat.completions", True),
    "langsam": Extra("masks from text by GroundingDINO and SAM, SAM 3 or VLPart", True),
    "graspnet": Extra("the generators VGN, GraspNet-1Billion and FGC-GraspNet", True),
    "server": Extra("the HTTP server and its client", True),
    "viz": Extra("following an episode in the browser (demo --live)", True),
    "rerun": Extra("recording episodes for the rerun viewer", False),
    "ompl": Extra("RRT* and other motion planners", True),
    "ray": Extra("benchmarks on a cluster (bench run --ray)", True),
    "ur": Extra("a real UR5e with a Robotiq gripper (run)", True),
    "realsense": Extra("Intel RealSense cameras (run, calibrate)", True),
    "calibration": Extra("hand-eye calibration (calibrate)", True),
}


@dataclass(frozen=True)
class SelfCheck:
    """What became of one decision on a rendered frame."""

    passed: bool
    message: str


def report(out: TextIO, *, weights: bool = False) -> bool:
    """Print the report, on request with all weights, and return whether the self-check passed."""
    print(f"thinkgrasp {__version__}", file=out)
    print(f"python     {platform.python_version()} ({sys.executable})", file=out)
    print(f"system     {platform.system()} {platform.machine()}", file=out)
    print("\nrequired", file=out)
    for package in requirements(None):
        print(f"  {package:<20} {installed_version(package) or 'MISSING: pip install thinkgrasp'}", file=out)
    print("\nextras", file=out)
    for name, extra in EXTRAS.items():
        missing = [p for p in requirements(name) if installed_version(p) is None]
        state = "installed" if not missing else f"missing {', '.join(missing)}"
        later = "" if extra.in_use else " (planned: nothing in this version uses it yet)"
        print(f"  {name:<10} {state}\n             for {extra.purpose}{later}", file=out)
        if missing:
            print(f"             pip install 'thinkgrasp[{name}]'", file=out)
    problem = torchvision_problem()
    if problem is not None:
        print(f"\nPROBLEM: {problem}\n{CURE}", file=out)
    print("\nplug-ins", file=out)
    for kind in registry.KINDS:
        print(f"  {kind:<10} {', '.join(registry.available(kind)) or 'none'}", file=out)
    if weights:
        report_weights(out)
    result = self_check()
    print(f"\nself-check {'passed' if result.passed else 'FAILED'}: {result.message}", file=out)
    return result.passed


def report_weights(out: TextIO) -> None:
    """Print of every known model what it is for, where it is, and the command that gets it where it is not."""
    print("\nweights", file=out)
    for entry in known_weights().values():
        found = entry.find()
        size = f", {entry.mb} MB" if entry.mb else ""
        print(f"  {entry.name:<22} {entry.purpose}", file=out)
        print(f"    licence: {entry.licence}{size}", file=out)
        if found is None:
            state = f"missing: {entry.command}"
        elif entry.intact(found):
            state = f"here: {found}"
        else:
            state = f"NOT THE KNOWN FILE (its SHA-256 differs): {found}"
        print(f"    {state}", file=out)
        if entry.note:
            print(f"    note: {entry.note}", file=out)


def self_check() -> SelfCheck:
    """Run the offline preset on a rendered table top and look whether it returns a grasp."""
    from thinkgrasp.config import make_pipeline
    from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render

    frame = render(demo_scene(0), *demo_camera()).frame
    try:
        pipeline = make_pipeline("offline")
        start = time.perf_counter()
        decision = pipeline.decide(frame, SELF_CHECK_INSTRUCTION)
    except ThinkGraspError as error:
        return SelfCheck(False, str(error))
    ms = (time.perf_counter() - start) * 1e3
    what = f"{SELF_CHECK_INSTRUCTION!r} on a rendered {frame.camera.width}x{frame.camera.height} frame"
    if decision.grasp is None:
        return SelfCheck(False, f"{what} gave {decision.status}: {decision.plan.rationale}")
    return SelfCheck(True, f"{what} gave a grasp with score {decision.grasp.score:.2f} in {ms:.0f} ms")


def requirements(extra: str | None) -> list[str]:
    """Return the names of the packages that this package needs: always (None), or for an extra."""
    found: list[str] = []
    for line in requires("thinkgrasp") or []:
        marker = re.search(r"extra\s*==\s*['\"]([^'\"]+)['\"]", line)
        if (marker.group(1) if marker else None) == extra:
            found.append(re.split(r"[\s<>=!~;\[(]", line, maxsplit=1)[0])
    return found


def installed_version(package: str) -> str | None:
    """Return the installed version of a package, or None."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
