"""Synthetic captures, whose cameras are known: what benchmarks and tests measure a capture against."""
