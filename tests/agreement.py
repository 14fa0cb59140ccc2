"""Moved to tests/helpers/assert_close.py."""

from tests.helpers.assert_close import (
    T as T,
    values_and_gradients as outcome,
    assert_agrees as agree,
    run_with_threads as with_threads,
)  # noqa: E501, F401, I001, PLC0414
