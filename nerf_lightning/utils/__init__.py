"""Helpers that know nothing of fields: files, seeds, the machine, its devices."""
