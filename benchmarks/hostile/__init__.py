"""Inputs that are damaged, absurd or malicious, and what the command line makes of them: each in a process of its own."""
