"""A page about a scene's photos before training: sharpness, exposure, cameras, and what the checks doubt."""
