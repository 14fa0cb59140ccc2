"""Run folders and the compact files made of them: found, read back without trusting them, and opened."""
