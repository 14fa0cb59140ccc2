"""Readers of scene file formats and image files, and checks of their contents."""
