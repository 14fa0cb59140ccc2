"""Structure from motion: poses and lenses of plain photos or a video."""
