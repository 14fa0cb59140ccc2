"""Moved to tests/helpers/shared_fixtures.py."""

# ruff: noqa
from tests.helpers.shared_fixtures import *
from tests.helpers.shared_fixtures import make_once as once
