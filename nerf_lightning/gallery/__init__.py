"""All runs of a sweep in one picture."""
