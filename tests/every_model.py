"""Moved to tests/helpers/train_models.py."""

# ruff: noqa
from tests.helpers.train_models import *

if __name__ == "__main__":
    import runpy

    runpy.run_module("tests.helpers.train_models", run_name="__main__")
