"""Base class of NeRF2D and NeRF3D: optimizer, schedule, and evaluation of whole views."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import lightning as L
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.dataset.datamodule import StepDataModule
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.model import Field, PictureField
from nerf_lightning.refine import Corrections
from nerf_lightning.sampler import CHUNK
from nerf_lightning.system.metrics import psnr, ssim
from nerf_lightning.system.state import TrainingState
from nerf_lightning.utils.device import synchronize
from nerf_lightning.utils.memory import release_freed_memory
from nerf_lightning.utils.seeding import Stream, step_generator

OptimizerFactory = Callable[[list[dict[str, Any]]], torch.optim.Optimizer]
Schedule = Callable[[float, int], float]
"""Progress in [0, 1] and step -> factor on the learning rate."""


@dataclass(frozen=True)
class StepStats:
    """Statistics of the last training step."""

    mse: Float[Tensor, ""]
    """On the device: reading it synchronizes."""
    rays: int
    """Rays, or pixels in 2D."""
    samples: int
    """Samples drawn; where they are not counted, as many per ray as at the last count."""
    opacity: Float[Tensor, "R"] | None = None
    """Opacity of each ray, on the device: 0 is empty, 1 is opaque."""
    squared_errors: Float[Tensor, "R"] | None = None
    """Squared error of each ray, on the device."""
    complete_rays: Bool[Tensor, "R"] | None = None
    """Rays that have all their samples; None for all."""
    losses: Mapping[str, Tensor] = field(default_factory=dict)
    """Terms of the loss by name, on the device."""

    def clone(self) -> "StepStats":
        """A copy of what is read only after further steps."""
        errors, complete = (None if x is None else x.clone() for x in (self.squared_errors, self.complete_rays))
        return replace(self, mse=self.mse.clone(), squared_errors=errors, complete_rays=complete)


@dataclass(frozen=True)
class ViewResult:
    """A rendered view and its ground truth. Colors in [0, 1]."""

    rgb: Float[Tensor, "H W 3"]
    truth: Float[Tensor, "H W 3"]
    psnr: float
    seconds: float
    """Rendering time."""
    depth: Float[Tensor, "H W"] | None = None
    opacity: Float[Tensor, "H W"] | None = None
    known: Bool[Tensor, "H W"] | None = None
    """Pixels that are scored; None for all."""
    strip: int | None = None
    """See `PixelSubset.strip`."""

    @property
    def num_pixels(self) -> int:
        return self.rgb.shape[:2].numel()

    @cached_property
    def ssim(self) -> float:
        """Structural similarity, computed on first access."""
        return ssim(self.rgb, self.truth, self.known, self.strip)

    @property
    def masked_truth(self) -> Float[Tensor, "H W 3"]:
        """The truth, replaced by the render where unknown."""
        return self.truth if self.known is None else torch.where(self.known[..., None], self.truth, self.rgb)

    @property
    def errors(self) -> Float[Tensor, "H W 3"]:
        """Absolute differences; 0 where the truth is unknown."""
        return (self.rgb - self.masked_truth).abs()


def sum_losses(losses: Mapping[str, Tensor]) -> Float[Tensor, ""]:
    """Total loss of a step."""
    first, *others = losses.values()
    return sum(others, first)


class System(L.LightningModule):
    """Base class of NeRF2D and NeRF3D.

    Args:
        field: uv -> rgb, or position, direction -> density, rgb.
        optimizer: makes the optimizer from the parameter groups.
        schedule: factor on the learning rate by progress and step.
        seed: of all randomness in training steps.
        chunk: samples rendered at once without gradient; bounds the memory of a view.
        state: training state shared with callbacks; None makes one.
    """

    def __init__(
        self,
        field: Field | PictureField,
        optimizer: OptimizerFactory,
        schedule: Schedule,
        seed: int = 0,
        chunk: int = CHUNK,
        state: TrainingState | None = None,
    ):
        super().__init__()
        self.field = field
        self.make_optimizer = optimizer
        self.schedule = schedule
        self.seed = seed
        self.chunk = chunk
        self.state = state or TrainingState()
        self.corrections: Corrections | None = None
        """Refinement of training cameras and exposure."""
        self.stats = StepStats(torch.tensor(math.nan), 0, 0)

    @property
    def is_graphable(self) -> bool:
        """Whether steps may run as CUDA graphs."""
        return False

    def warm_start_from(self, source: "System") -> None:
        """Initializes from a trained system whose field is a smaller one of the same kind."""
        field: Any = self.field
        field.warm_start_from(source.field)

    @property
    def exportable_modules(self) -> dict[str, Any]:
        """Modules of a compact file by name: those with `export_state` and `import_state`."""
        return {name: module for name, module in self.named_children() if hasattr(module, "export_state")}

    @property
    def is_corrected(self) -> bool:
        """Whether poses or exposure of the training photos are corrected."""
        return self.corrections is not None and bool(self.corrections.enabled_at)

    def compute_losses(self, batch: Any, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        """Losses of a step by name, and its statistics. All randomness comes from `generator`."""
        raise TypeError(f"{type(self).__name__} must define compute_losses(batch, generator)")

    def warm_up_kernels(self, batch: Any) -> None:
        """Runs a forward and backward pass, so that kernels are compiled."""
        losses, _ = self.compute_losses(batch.to(self.device), step_generator(0, Stream.STEP, 0, self.device))
        sum_losses(losses).backward()

    def param_groups(self) -> list[dict[str, Any]]:
        """Named parameter groups of the optimizer; one without `lr` takes the optimizer's."""
        return [{"name": "field", "params": list(self.parameters())}]

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        """Learning-rate factors of the parameter groups, by name."""
        return {"field": self.schedule(progress, step)}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        optimizer = self.make_optimizer(self.param_groups())
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        return optimizer

    def set_learning_rates(self, optimizer: torch.optim.Optimizer, step: int) -> None:
        factors = self.lr_factors(self.state.progress, step)
        for group in optimizer.param_groups:
            lr = group["initial_lr"] * factors[group["name"]] * self.state.lr_scale
            if "capturable" in group:
                group["capturable"] = self.is_graphable
            if not group.get("capturable"):
                group["lr"] = lr
            elif isinstance(group["lr"], Tensor) and group["lr"].device.type == self.device.type:
                group["lr"].fill_(lr)
            else:
                group["lr"] = torch.tensor(lr, device=self.device)  # a CUDA graph reads it

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.trainer.max_steps > 0:
            self.state.set_progress(max(self.state.progress, self.global_step / self.trainer.max_steps))
        self.set_learning_rates(self.trainer.optimizers[0], self.global_step)

    def set_first_step(self, step: int) -> None:
        """Called when a run resumes whose training was restarted at `step`."""

    def restart(self, step: int) -> None:
        """Called when training restarts at `step` with fresh weights."""

    def compute_target_rgb(self, batch: Any, is_training: bool = False) -> Float[Tensor, "N 3"]:
        """Target colors of a batch: in evaluation, or as training steps see them."""
        raise TypeError(f"{type(self).__name__} must define compute_target_rgb(batch)")

    def render_view(
        self, view: Any
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"] | None, Float[Tensor, "N"] | None]:
        """Rendered colors of a whole view, with depth and opacity if the field has them."""
        raise TypeError(f"{type(self).__name__} must define render_view(view)")

    @property
    def background(self) -> list[float] | None:
        """Background color of evaluated views; None for an image."""
        return None

    def measure_off_grid_psnr(self, view: Any) -> float | None:
        """PSNR between the pixels of an image; None where it does not apply."""
        return None

    def diagnose(self, view: Any) -> str:
        """Explains why a field has learned nothing; "" if unknown."""
        return ""

    @torch.no_grad()
    def evaluate(self, view: Any) -> ViewResult:
        """Renders a whole view and computes its metrics."""
        view = view.to(self.device)
        synchronize(self.device)
        start = time.perf_counter()
        rgb, depth, opacity = self.render_view(view)
        synchronize(self.device)
        seconds = time.perf_counter() - start

        def image(x: Tensor) -> Tensor:
            return x.view(view.height, view.width, *x.shape[1:]).cpu()

        rgb, truth = image(rgb.clamp_(0, 1)), image(self.compute_target_rgb(view))
        depth, opacity, known = (None if x is None else image(x) for x in (depth, opacity, view.valid_mask))
        return ViewResult(rgb, truth, psnr(rgb, truth, known), seconds, depth, opacity, known, view.strip)

    def evaluate_views(self, views: Iterable[Any]) -> Iterator[ViewResult]:
        """Evaluates views one by one, after releasing the memory that training has freed."""
        self.zero_grad()  # as the next step does anyway
        release_freed_memory()
        try:
            yield from map(self.evaluate, views)
        finally:
            release_freed_memory()

    def evaluate_held_out(
        self, data: StepDataModule, views: Iterable[int], subset: PixelSubset = ALL_PIXELS
    ) -> Iterator[ViewResult]:
        """Evaluates held-out views, or a subset of their pixels."""
        return self.evaluate_views(data.get_held_out_view(view, subset) for view in views)

    def on_test_start(self) -> None:
        release_freed_memory()

    def test_step(self, batch: Any, batch_idx: int) -> dict[str, float]:
        result = self.evaluate(batch)
        truth = result.truth if result.known is None else result.truth[result.known][None]
        constant_color = truth.mean((0, 1)).expand_as(truth)
        metrics = {"psnr": result.psnr, "ssim": result.ssim, "seconds": result.seconds}
        return {**metrics, "constant_color_psnr": psnr(constant_color, truth)}
