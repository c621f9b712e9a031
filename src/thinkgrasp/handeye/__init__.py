"""Where a camera is, from pictures of a board and poses of an arm: hand-eye calibration."""
