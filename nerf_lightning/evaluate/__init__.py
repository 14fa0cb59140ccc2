"""Per-view image quality of a trained run."""
