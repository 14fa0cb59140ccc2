"""Moved to tests/helpers/soft_ball.py."""

# ruff: noqa
from tests.helpers.soft_ball import BOX, soft_ball as blob, cameras_around_ball as around_it
