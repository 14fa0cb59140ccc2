"""How good a trained run is, view by view, on its own photos or on others."""
