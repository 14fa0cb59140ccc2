"""Command line: one typed function per command defines its options, bounds, help and Python API."""
