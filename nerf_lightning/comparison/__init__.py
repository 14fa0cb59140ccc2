"""Runs -> configurations compared by quality and cost: a page, a table, a figure, and advice in words."""
