"""Moved to tests/helpers/ragged_samples.py."""

from tests.helpers.ragged_samples import COUNTS as COUNTS, MANY as MANY, ragged_samples as ragged  # noqa: E501, F401, I001, PLC0414
