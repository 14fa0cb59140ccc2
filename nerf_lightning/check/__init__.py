"""HTML report on a scene before training: sharpness, exposure, duplicates, cameras and consistency checks."""
