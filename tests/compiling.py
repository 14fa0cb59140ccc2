"""Moved to tests/helpers/compile_models.py."""

from tests.helpers.compile_models import (
    TRACED as TRACED,
    BOX as BOX,
    FIELDS as FIELDS,
    SIZES as SIZES,
    outcome as outcome,
    check_field as check_field,
    trained as trained,
)  # noqa: E501, F401, I001, PLC0414
