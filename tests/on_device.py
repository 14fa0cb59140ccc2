"""Moved to tests/helpers/device_runs.py."""

from tests.helpers.device_runs import (
    SCENES as SCENES,
    ON_IT as ON_IT,
    QUICK as QUICK,
    SAMPLERS as SAMPLERS,
    options as options,
    system_of as system_of,
    stepped as stepped,
)  # noqa: E501, F401, I001, PLC0414
