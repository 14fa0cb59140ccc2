"""Figures for checking a capture."""
