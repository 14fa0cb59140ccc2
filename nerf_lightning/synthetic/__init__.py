"""Synthetic scenes with exact geometry, and corruptions of scenes, for tests, benchmarks and the stability suite."""
