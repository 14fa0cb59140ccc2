"""A trained run or a scene in the browser."""
