"""Moved to tests/helpers/fake_device.py."""

# ruff: noqa
from tests.helpers.fake_device import *
