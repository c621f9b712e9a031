"""For authors of plug-ins: run a plug-in on small built-in scenes and learn which rule of its contract it breaks.

    from thinkgrasp.testing import check_planner
    check_planner(MyPlanner())          # raises ContractError with the broken rule

The package's own stages are checked by the same functions.
"""

from thinkgrasp.testing.contracts import check_check, check_generator, check_planner, check_scene, check_segmenter
from thinkgrasp.testing.devices import check_camera, check_recorder, check_robot
from thinkgrasp.testing.scenes import empty_scene, sample_frame, sample_scene, strict_scene

__all__ = [
    "check_camera",
    "check_check",
    "check_generator",
    "check_planner",
    "check_recorder",
    "check_robot",
    "check_scene",
    "check_segmenter",
    "empty_scene",
    "sample_frame",
    "sample_scene",
    "strict_scene",
]
