"""Photos with printed tags -> scene: detection, calibration, poses, undistortion."""
