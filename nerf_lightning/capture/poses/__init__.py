"""From corners in photos to the camera and where it stood."""
