"""Synthetic captures with known cameras, for benchmarks and tests."""
