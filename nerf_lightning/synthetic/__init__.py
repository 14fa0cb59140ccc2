"""Synthetic scenes with exact geometry, for the stability suite, tests and benchmarks, and ways to corrupt them."""
