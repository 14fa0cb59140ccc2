"""From plain photos or a video to photos with known cameras: structure from motion."""
