"""Browser viewers of trained runs and scenes, based on Viser."""
