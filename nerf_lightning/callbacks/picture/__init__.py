"""Charts and comparisons of 2D runs."""
