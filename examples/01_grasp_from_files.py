"""Find a grasp on an RGB-D frame that lies in files.

Without arguments a table top is rendered and saved first, so that there is something to read:

    python examples/01_grasp_from_files.py
    python examples/01_grasp_from_files.py color.png depth.png camera.json "the red box"
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from thinkgrasp import load_frame, make_pipeline
from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render


def rendered_files() -> list[str]:
    """Save a rendered frame into a temporary folder and return its paths."""
    folder = Path(tempfile.mkdtemp(prefix="thinkgrasp-example-"))
    frame = render(demo_scene(seed=0), *demo_camera()).frame
    return [str(path) for path in save_frame(frame, folder)]


def main(arguments: list[str]) -> None:
    """Load the frame, decide, and print the grasp."""
    color, depth, camera, *rest = arguments or rendered_files()
    instruction = rest[0] if rest else "the red box"

    frame = load_frame(color, depth, camera)
    decision = make_pipeline("offline").decide(frame, instruction)

    print(f"{instruction!r}: {decision.status}")
    print(decision.plan.rationale)
    if decision.grasp is not None:
        grasp = decision.grasp
        print("TCP in the camera frame [m]:", grasp.position.round(3).tolist())
        print("approach direction:", grasp.rotation[:, 2].round(3).tolist())
        print(f"opening {grasp.width_m * 1000:.0f} mm, score {grasp.score:.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
