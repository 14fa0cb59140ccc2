"""Helpers independent of radiance fields: files, seeds, machine, devices, signals."""
