"""Matches between photos: whether cameras explain them, what was mistaken where they do not, and points in space from them."""
