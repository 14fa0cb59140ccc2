"""Runs -> points of speed and accuracy, what can be compared with what, which methods are worth their time."""
