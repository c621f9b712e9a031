"""What measures the pipeline in the simulator and is no part of it."""
