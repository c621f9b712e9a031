"""Let the pipeline act as the policy of a Gymnasium environment, until the goal is in the bin.

Needs the simulator: pip install 'thinkgrasp[sim]'

    python examples/05_gymnasium.py
"""

from __future__ import annotations

import gymnasium

from thinkgrasp.config import load_config, make_pipeline
from thinkgrasp.environment import GraspingEnv, pose_action
from thinkgrasp.testbed import for_the_loop


def main() -> None:
    """Run one episode; the policy sees the images and the sentence, never `info`."""
    env = gymnasium.make("ThinkGrasp/Clutter-v1")
    cell = env.unwrapped
    assert isinstance(cell, GraspingEnv)
    policy = make_pipeline(for_the_loop(load_config("offline")))

    observation, info = env.reset(seed=0, options={"task": "pear", "visibility": "visible"})
    print(f"{info['task']}: {observation['instruction']!r}")
    terminated = truncated = False
    while not (terminated or truncated):
        decision = policy.decide(cell.frame, observation["instruction"])
        if decision.grasp is None:
            break
        action = pose_action(decision.grasp, cell.frame)
        observation, reward, terminated, truncated, info = env.step(action)
        print(f"{decision.plan.target}: {info['outcome']}, in the bin: {info['delivered']}, reward {reward}")
    print("delivered" if terminated else "not delivered")


if __name__ == "__main__":
    main()
