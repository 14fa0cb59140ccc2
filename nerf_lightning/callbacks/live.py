"""Live: the field in the browser while it trains."""

import time
from typing import TYPE_CHECKING, Any

import lightning as L

from nerf_lightning.callbacks.attached import ChecksData, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.dataset import PixelDataModule, RayDataModule, Scene
from nerf_lightning.errors import InputError
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.options import Port
from nerf_lightning.view.serve import announcement, find_port, require_viser

if TYPE_CHECKING:
    from nerf_lightning.view.field_page import FieldPage

SAVED = 0.2
"""Most seconds of drawing that can be saved up while nobody is looking."""
ONE = 0.06
"""Seconds that one picture may take."""


class Live(ChecksData):
    """Serves a page that shows the field between training steps, with the training clock stopped.

    It draws only while somebody is looking, and for at most a share of the time.

    Args:
        host: address to listen on; 0.0.0.0 shares the page with the network.
        port: the next free one if it is in use; 0 for any.
        share: of the time that drawing may take, above 0 and below 1.
        photo_side: longest side of the photos on the frusta, pixels.
        side: pixels along the longer side of the finest picture.

    Raises:
        InputError: for any other share; at the start of training, if it is a picture's, Viser is not installed, or the
            address does not exist.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: Port = 8080, share: float = 0.06, photo_side: int = 120, side: int = 512
    ):
        if not 0 < share < 1:
            raise InputError("callbacks.live.share", "", str(share), "above 0 and below 1")
        self.host = host
        self.port = port
        self.share = share
        self.photo_side = photo_side
        self.side = side
        self.page: FieldPage | None = None
        self._credit = 0.0
        self._seen = 0.0

    def check(self, data: RayDataModule | PixelDataModule) -> None:
        if isinstance(data, PixelDataModule):
            raise InputError("config", "callbacks", "live", "a scene's run", "pictures have training.gif")
        require_viser()

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage != "fit" or not trainer.is_global_zero:
            return
        scene = data_of(trainer).scene
        assert isinstance(pl_module, NeRF3D) and isinstance(scene, Scene)  # `check` sees to it
        address, free = find_port(self.host, self.port)

        from nerf_lightning.view.field_page import FieldPage

        self.page = FieldPage(scene.name, pl_module, scene.orbit, scene, self.host, free, self.photo_side, self.side)
        line = announcement(scene.name, self.host, address, self.port, self.page.port)
        print(f"live: {line.removesuffix('; Ctrl-C ends it')}", flush=True)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._seen = time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self.page is None:
            return
        now = time.perf_counter()
        self._credit = min(self._credit + self.share * (now - self._seen), SAVED)
        self._seen = now
        if self._credit <= 0 or not self.page.visitors:
            return
        with Budget.of(trainer).paused():
            self.page.again()
            self.page.paint(ONE)
        self._seen = time.perf_counter()
        self._credit -= self._seen - now

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if self.page is not None and stage == "fit":
            self.page.stop()
            self.page = None
