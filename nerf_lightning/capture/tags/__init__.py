"""Printed tags: layouts, boards, detection, and a sheet to print."""
