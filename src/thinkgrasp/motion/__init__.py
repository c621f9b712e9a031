"""From a grasp in the world to joint trajectories: kinematics, collision, planning, timing."""
