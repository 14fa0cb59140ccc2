"""Camera calibration and poses from detected tags."""
