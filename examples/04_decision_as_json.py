"""Turn a decision into the published JSON, and read it back: what the command line, robots and logs exchange.

python examples/04_decision_as_json.py
"""

from __future__ import annotations

from thinkgrasp import make_pipeline
from thinkgrasp.schema import DecisionModel, decision_to_schema, mask_from_png
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render


def main() -> None:
    """Write and read one decision."""
    frame = render(demo_scene(seed=0), *demo_camera()).frame
    decision = make_pipeline("offline").decide(frame, "the tomato soup can")
    text = decision_to_schema(decision, standoff_m=0.12).to_json()

    read = DecisionModel.model_validate_json(text)
    print(f"{len(text)} characters, schema {read.schema_}, status {read.status}")
    if read.grasp is not None and read.target is not None and read.target.mask_png is not None:
        print(f"in the {read.grasp.frame} frame: from {read.grasp.pregrasp_position_m} to {read.grasp.position_m} m")
        print(f"the target covers {int(mask_from_png(read.target.mask_png).sum())} pixels")


if __name__ == "__main__":
    main()
