"""Run folders as something else: a small file, ready to render."""
