"""LiveViewer: the field in the browser while it trains."""

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

MAX_IMAGE_SIDE, MAX_IMAGE_SECONDS = 512, 0.06
"""Of an image: pixels along its longer side, and the time that it may take."""


class LiveViewer(L.Callback):
    """Serves a page that shows the field between training steps, with the training clock stopped, and how far training is.

    It draws only while somebody is looking, and for at most a share of the time. When training is done, the page stays open
    as long as a browser shows it.

    Args:
        host: address to listen on; 0.0.0.0 shares the page with the network.
        port: the next free one if it is in use; 0 for any.
        max_time_fraction: of the time that drawing may take.

    Raises:
        InputError: at the start of training, if it is an image's, Viser is not installed, or the address does not exist.
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
        self._next_draw = 0.0  # when drawing may take time again, by `time.perf_counter`

    def check(self, data: DataModule) -> None:
        """Called before a run writes anything."""
        if not data.is_posed:
            raise InputError("config", "callbacks", "live needs a scene", hint="pictures have training.gif")
        require_viser()

    def setup(self, trainer: L.Trainer, pl_module: NeRF3D, stage: str) -> None:
        if stage != "fit" or not trainer.is_global_zero:
            return
        scene = get_datamodule(trainer).scene
        resolve_host(self.host)

        from nerf_lightning.view.field_page import FieldPage

        self.page = FieldPage(
            scene.name, pl_module, scene.orbit, scene, self.host, self.port, MAX_IMAGE_SIDE, live=True
        )
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
        """Ends the page, called when all is written.

        Args:
            psnr: held out, dB.
            keep_open: whether to serve the finished field until no browser shows it any more.
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
