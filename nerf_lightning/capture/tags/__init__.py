"""Printed tags: sheets, boards, and where photos show them."""
