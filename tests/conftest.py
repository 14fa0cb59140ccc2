"""Fixtures that all tests share."""

from pathlib import Path

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "real_data: needs the photos that stand beside the checkout; skips without them")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scenes beside the checkout."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no shared/data beside the checkout")
    return folder
