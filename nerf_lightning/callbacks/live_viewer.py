"""Live viewer: the field in the browser while it trains."""

import time
from typing import TYPE_CHECKING, Annotated, Any

import lightning as L

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.progress import describe_progress
from nerf_lightning.callbacks.trainer_access import get_datamodule
from nerf_lightning.dataset import DataModule
from nerf_lightning.errors import InputError
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.option_checks import Ge, Le, Port
from nerf_lightning.view.serve import announce, require_viser, resolve_host

if TYPE_CHECKING:
    from nerf_lightning.view.field_page import FieldPage

MAX_SIDE_PX, MAX_IMAGE_SECONDS = 512, 0.06
"""Longer side of an image in pixels, and its render seconds."""


class LiveViewer(L.Callback):
    """Serves a page that shows the field and its progress between training steps, with the training clock stopped.

    It renders only while a browser is connected, for at most a fraction of the time. After training, the page stays open as
    long as a browser shows it.

    Args:
        host: address to listen on; 0.0.0.0 shares the page with the network.
        port: the next free one if it is in use; 0 for any.
        max_time_fraction: fraction of the time that rendering may take.

    Raises:
        InputError: at the start of training, for a 2D field, without Viser, or if the address does not exist.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: Port = 8080,
        max_time_fraction: Annotated[float, Ge(0.001), Le(0.99)] = 0.06,
    ):
        self.host = host
        self.port = port
        self.max_time_fraction = max_time_fraction
        self.page: FieldPage | None = None
        self._next_draw = 0.0  # earliest time of the next image, by `time.perf_counter`

    def check(self, data: DataModule) -> None:
        """Checks the data, before a run writes anything."""
        if not data.is_posed:
            raise InputError("config", "callbacks", "live needs a scene", hint="pictures have training.gif")
        require_viser()

    def setup(self, trainer: L.Trainer, pl_module: NeRF3D, stage: str) -> None:
        if stage != "fit" or not trainer.is_global_zero:
            return
        scene = get_datamodule(trainer).scene
        resolve_host(self.host)

        from nerf_lightning.view.field_page import FieldPage

        self.page = FieldPage(scene.name, pl_module, scene.orbit, scene, self.host, self.port, MAX_SIDE_PX, live=True)
        print(f"live: {announce(scene.name, self.host, self.port, self.page.port)}", flush=True)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        start = time.perf_counter()
        if self.page is None or not self.page.clients or start < self._next_draw:
            return
        with Budget.find(trainer).pause():
            self.page.show_progress(pl_module.state.progress, ", ".join(describe_progress(trainer)))
            self.page.invalidate()
            self.page.render_next(MAX_IMAGE_SECONDS)
        end = time.perf_counter()
        self._next_draw = end + (end - start) * (1 / self.max_time_fraction - 1)

    def on_test_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        if self.page is not None:
            self.page.show_progress(1.0, f"trained; measuring: {', '.join(describe_progress(trainer))}")
            self.page.render_next(MAX_IMAGE_SECONDS)

    def finish(self, psnr: float | None, keep_open: bool) -> None:
        """Closes the page, after a run has written everything.

        Args:
            psnr: held-out PSNR in dB.
            keep_open: whether to serve the trained field until no browser shows it.
        """
        if self.page is None:
            return
        self.page.invalidate()
        self.page.show_progress(1.0, "training is done" + ("" if psnr is None else f": held out {psnr:.2f} dB"))
        page, self.page = self.page, None
        try:
            if keep_open and page.clients:
                print("live: training is done; the page stays open until it is closed, or Ctrl-C", flush=True)
            page.run(ended=lambda: not (keep_open and page.clients))
        finally:
            page.stop()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        if self.page is not None:
            self.page.stop()
            self.page = None
