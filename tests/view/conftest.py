import pytest

from nerf_lightning.dataset import Scene
from nerf_lightning.synthetic.bricks import bricks


@pytest.fixture(scope="session")
def scene() -> Scene:
    return bricks(size=16, train_views=4, val_views=2, orbit_views=6)
