"""Moved to tests/helpers/soft_ball.py."""

from tests.helpers.soft_ball import BOX as BOX, cameras_around_ball as around_it, soft_ball as blob  # noqa: E501, F401, I001, PLC0414
