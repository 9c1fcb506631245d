"""From image points to positions: poses, the positioner, the trajectory, calibration."""
