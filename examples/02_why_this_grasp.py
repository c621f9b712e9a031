"""Ask a decision why: the objects in view, what obstructs them, the funnel of the checks, and the alternatives.

python examples/02_why_this_grasp.py "the blue cup"
"""

from __future__ import annotations

import sys

from thinkgrasp import make_pipeline
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render


def main(instruction: str) -> None:
    """Decide on a rendered table top and print everything that led to the grasp."""
    frame = render(demo_scene(seed=0), *demo_camera()).frame
    decision = make_pipeline("offline", n_nearest=5).decide(frame, instruction)
    scene = decision.scene

    print("seen:")
    for p in scene.proposals:
        color = p.colors[0][0] if p.colors else "?"
        shape = p.shapes[0][0] if p.shapes else "?"
        size = " x ".join(f"{100 * side:.0f}" for side in p.extents_m)
        print(f"  mark {p.mark}: {color}, {shape}, {size} cm, confidence {p.confidence:.2f}")
    for edge in scene.obstructions:
        print(f"  mark {edge.a} {edge.relation.replace('_', ' ')} mark {edge.b} ({edge.evidence:.3g} {edge.unit})")

    print(f"\n{instruction!r}: {decision.status} on {decision.plan.target} ({decision.plan.role})")
    print(f"because {decision.plan.rationale}")
    for step in decision.funnel:
        print(f"  {step.check:<16} {step.n_in:>4} -> {step.n_out}")
    for fallback in decision.degraded:
        print(f"  fell back in {fallback.stage}: {fallback.reason}; used {fallback.fallback}")
    print("scores, best first:", [round(g.score, 2) for g in (decision.grasp, *decision.alternatives) if g is not None])
    print("times [ms]:", {stage: round(ms) for stage, ms in decision.timings_ms})


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "the blue cup")
