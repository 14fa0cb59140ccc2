"""One training run, and many from one command line."""
