"""Fixtures that all tests share."""

import os
from pathlib import Path

from jaxtyping import install_import_hook

# Before anything imports the package: from here on a wrong shape fails the test that met it.
install_import_hook("nerf_lightning", "typechecker.check")

# ruff: noqa: E402
import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scenes beside the checkout."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no shared/data beside the checkout")
    return folder


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Tests neither read nor fill the user's cache."""
    os.environ["NERF_LIGHTNING_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def same_chance() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> Path:
    """The folder of a finished run on the built-in scene, seconds long."""
    from composing import composed

    from nerf_lightning.training import train

    folder = tmp_path_factory.mktemp("run")
    train(composed(["+experiment=smoke_3d", "dataset.size=16", "budget.steps=10", "callbacks.orbit.frames=0"], folder))
    return folder
