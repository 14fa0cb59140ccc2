"""The command line: a module a command, each a typed function that gives options, ranges, help and the Python interface."""
