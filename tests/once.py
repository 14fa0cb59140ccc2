"""Moved to tests/helpers/shared_fixtures.py."""

from tests.helpers.shared_fixtures import T as T, shared_folder as shared_folder, make_once as once  # noqa: E501, F401, I001, PLC0414
