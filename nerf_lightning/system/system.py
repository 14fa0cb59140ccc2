"""What NeRF2D and NeRF3D share: the optimiser, its schedule, and the evaluation of whole views."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
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
    """What the last training step did."""

    mse: Float[Tensor, ""]
    """On the device: reading it means waiting for it."""
    rays: int
    """Rays, or pixels in 2D."""
    samples: int
    opacity: Float[Tensor, "R"] | None = None
    """Of each ray, on the device: 0 is empty, 1 is opaque."""
    squared_errors: Float[Tensor, "R"] | None = None
    """Squared error of each ray, on the device."""
    complete_rays: Bool[Tensor, "R"] | None = None
    """Which rays have all their samples; None for all."""
    losses: Mapping[str, Tensor] = field(default_factory=dict)
    """What the loss is the sum of, by name, on the device."""

    @property
    def is_sample_count_exact(self) -> bool:
        """Whether `samples` is their count; otherwise it is the room for them."""
        return self.complete_rays is None


@dataclass(frozen=True)
class ViewResult:
    """One view rendered, beside its truth. Colours in [0, 1]."""

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
        """How many were rendered."""
        return self.rgb.shape[:2].numel()

    @cached_property
    def ssim(self) -> float:
        """Structural similarity: where nobody asks, its time is saved."""
        return ssim(self.rgb, self.truth, self.known, self.strip)

    @property
    def masked_truth(self) -> Float[Tensor, "H W 3"]:
        """The truth; the render itself where the truth is not known."""
        return self.truth if self.known is None else torch.where(self.known[..., None], self.truth, self.rgb)

    @property
    def errors(self) -> Float[Tensor, "H W 3"]:
        """Absolute differences; 0 where the truth is not known."""
        return (self.rgb - self.masked_truth).abs()


def sum_losses(losses: Mapping[str, Tensor]) -> Float[Tensor, ""]:
    """What a step minimises: the sum of its losses."""
    first, *others = losses.values()
    return sum(others, first)


class System(L.LightningModule):
    """Base of the two systems.

    Args:
        field: place -> rgb, or position, direction -> density, rgb.
        optimizer: makes the optimiser from the parameters.
        schedule: factor on its learning rate by progress and step.
        seed: of all randomness in training steps.
        chunk: samples rendered at once without gradient: bounds the memory that a view of any size takes.
        compile_backend: compiler of the parts of a training step, see `torch_compile.maybe_compile`; None does not compile.
        state: of the training, shared with the callbacks that steer it; None makes one.
    """

    def __init__(
        self,
        field: Field | PictureField,
        optimizer: OptimizerFactory,
        schedule: Schedule,
        seed: int = 0,
        chunk: int = CHUNK,
        compile_backend: str | None = None,
        state: TrainingState | None = None,
    ):
        super().__init__()
        self.field = field
        self.make_optimizer = optimizer
        self.schedule = schedule
        self.seed = seed
        self.chunk = chunk
        self.compile_backend = compile_backend
        self.state = state or TrainingState()
        self.corrections: Corrections | None = None
        """Of the training photos' cameras and light."""
        self.stats = StepStats(torch.tensor(math.nan), 0, 0)

    def warm_start_from(self, source: "System") -> None:
        """Continues from what a system with a smaller field of the same kind has learned."""
        field: Any = self.field
        field.warm_start_from(source.field)

    @property
    def exportable_modules(self) -> dict[str, Any]:
        """What a compact file keeps, by name: modules with `export_state` and `import_state`."""
        return {name: module for name, module in self.named_children() if hasattr(module, "export_state")}

    @property
    def is_corrected(self) -> bool:
        """Whether cameras or light of the training photos were corrected."""
        return self.corrections is not None and bool(self.corrections.enabled_at)

    def compute_losses(self, batch: Any, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        """The losses of a step by name, and what it did. All its randomness comes from `generator`."""
        raise TypeError(f"{type(self).__name__} must define compute_losses(batch, generator)")

    def warm_up_kernels(self, batch: Any) -> None:
        """Computes the gradients of a step, so that kernels are compiled."""
        losses, _ = self.compute_losses(batch.to(self.device), step_generator(0, Stream.STEP, 0, self.device))
        sum_losses(losses).backward()

    def param_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups of parameters, each with a name; without `lr`, one takes the optimiser's own."""
        return [{"name": "field", "params": list(self.parameters())}]

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        """Factors on the groups' learning rates, by name."""
        return {"field": self.schedule(progress, step)}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        optimizer = self.make_optimizer(self.param_groups())
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        return optimizer

    def set_learning_rates(self, optimizer: torch.optim.Optimizer, step: int) -> None:
        """Sets each group's learning rate for a step."""
        factors = self.lr_factors(self.state.progress, step)
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * factors[group["name"]] * self.state.lr_scale

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.trainer.max_steps > 0:
            self.state.set_progress(max(self.state.progress, self.global_step / self.trainer.max_steps))
        self.set_learning_rates(self.trainer.optimizers[0], self.global_step)

    def set_first_step(self, step: int) -> None:
        """Called where training goes on that started again at a step."""

    def restart(self, step: int) -> None:
        """Called when training starts again at a step, with a fresh field."""

    def compute_target_rgb(self, batch: Any) -> Float[Tensor, "N 3"]:
        """The colours that a batch should have in evaluation."""
        raise TypeError(f"{type(self).__name__} must define compute_target_rgb(batch)")

    def render_view(
        self, view: Any
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"] | None, Float[Tensor, "N"] | None]:
        """The field's colours of a whole view, with depth and opacity if it has them."""
        raise TypeError(f"{type(self).__name__} must define render_view(view)")

    @property
    def background(self) -> list[float] | None:
        """The background of evaluated views; None for a picture."""
        return None

    def measure_off_grid_psnr(self, view: Any) -> float | None:
        """PSNR of a picture's field between its pixels; None where there is none to measure."""
        return None

    def diagnose(self, view: Any) -> str:
        """What is wrong with a field that has learned nothing, in words; "" if unknown."""
        return ""

    @torch.no_grad()
    def evaluate(self, view: Any) -> ViewResult:
        """Renders a whole view and measures it."""
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
        """Evaluates views one after the other, in memory that training has given back."""
        self.zero_grad()  # which the next step does in any case
        release_freed_memory()
        try:
            yield from map(self.evaluate, views)
        finally:
            release_freed_memory()

    def evaluate_held_out(
        self, data: StepDataModule, views: Iterable[int], subset: PixelSubset = ALL_PIXELS
    ) -> Iterator[ViewResult]:
        """Evaluates some of the held-out views, or some of their pixels."""
        return self.evaluate_views(data.get_held_out_view(view, subset) for view in views)

    def on_test_start(self) -> None:
        release_freed_memory()

    def test_step(self, batch: Any, batch_idx: int) -> dict[str, float]:
        result = self.evaluate(batch)
        truth = result.truth if result.known is None else result.truth[result.known][None]
        constant_color = truth.mean((0, 1)).expand_as(truth)
        metrics = {"psnr": result.psnr, "ssim": result.ssim, "seconds": result.seconds}
        return {**metrics, "constant_color_psnr": psnr(constant_color, truth)}
