"""Robots that execute grasps: behind one contract, whether simulated or real."""
