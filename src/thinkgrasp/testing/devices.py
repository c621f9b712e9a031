"""The rules of cameras, robots and recorders, checked by running a plug-in."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from thinkgrasp import interfaces
from thinkgrasp.testing.rules import Refusal, guard, has_method, rule, run, unless_refused
from thinkgrasp.testing.scenes import sample_frame, sample_scene, top_down_grasps
from thinkgrasp.types import Decision, Frame, Outcome, Plan


def check_camera(plugin: interfaces.Camera) -> None:
    """Check that a camera gives frames, again and again. Frame checks sizes and types itself."""
    has_method(plugin, interfaces.Camera)
    frames = [guard("read()", plugin.read) for _ in range(2)]
    for frame in frames:
        rule(isinstance(frame, Frame), "read()", f"must return Frame, got {type(frame).__name__}")
        rule(bool((frame.depth > 0).any()), "read()", "the depth holds no return at all")
    rule(frames[0].camera == frames[1].camera, "read()", "the intrinsics changed between two frames")


def check_robot(plugin: interfaces.Robot) -> None:
    """Check a robot by grasps on a table top, from below it and far away, and by a frame without camera pose.

    It MOVES: give it a simulated or disconnected arm. Only the missing pose may be refused; what a grasp came to is
    always told by an outcome.
    """
    has_method(plugin, interfaces.Robot)
    scene = sample_scene()
    grasp = top_down_grasps(scene, scene.proposals[0]).at(0)
    grasps = {
        "a top-down grasp": grasp,
        "a grasp from under the table": replace(grasp, rotation=grasp.rotation @ np.diag([1.0, -1.0, -1.0])),
        "a grasp 5 m away": replace(grasp, position=grasp.position + np.array([0.0, 0.0, 5.0])),
    }
    for what, g in grasps.items():
        call = f"execute({what})"
        outcome = run(call, lambda g=g: plugin.execute(g, scene.frame), (g, scene), Outcome, deterministic=False)
        _check_outcome(call, outcome)
    call, frame = "execute(a frame without camera pose)", sample_frame(pose=False)
    answer = run(
        call,
        lambda: unless_refused(lambda: plugin.execute(grasp, frame)),
        (grasp, frame),
        object,
        deterministic=False,
    )
    if not isinstance(answer, Refusal):
        rule(isinstance(answer, Outcome), call, f"must return Outcome, got {type(answer).__name__}")
        _check_outcome(call, cast(Outcome, answer))


def check_recorder(plugin: interfaces.Recorder) -> None:
    """Check that a recorder takes decisions with and without grasp and outcome."""
    has_method(plugin, interfaces.Recorder)
    scene = sample_scene()
    nothing = Decision("no_target", "the kettle", scene, Plan("kettle", "none in view", found=False))
    grasp = top_down_grasps(scene, scene.proposals[0]).at(0)
    full = Decision("grasp", "a thing", scene, Plan("thing", "test", mark=1), grasp=grasp)
    for decision, outcome in ((nothing, None), (full, None), (full, Outcome(True, "held"))):
        call = f"record({decision.status}, {outcome})"
        result = guard(call, lambda d=decision, o=outcome: cast(object, plugin.record(d, o)))
        rule(result is None, call, f"must return None, got {type(result).__name__}")


def _check_outcome(call: str, outcome: Outcome) -> None:
    rule(isinstance(outcome.success, bool), call, f"success must be bool, got {type(outcome.success).__name__}")
    reason = outcome.reason
    named = isinstance(reason, str) and reason.isidentifier() and reason.islower()
    rule(named, call, f"reason must name what became of the grasp, as 'held' or 'missed', got {reason!r}")
    rule(outcome.success == (reason == "held"), call, f"success is told as 'held' and nothing else is, got {outcome}")
