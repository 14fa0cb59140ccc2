"""Results: everything a comparison needs to know about a run, in one results.json."""

import math
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from statistics import fmean, median
from typing import Any

import lightning as L
import torch

import nerf_lightning
from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.diagnosis import gap, wild_between
from nerf_lightning.callbacks.guard import Guard
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.callbacks.render_plan import Need, Renders
from nerf_lightning.callbacks.rendering import share_of
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS, Throughput
from nerf_lightning.dataset import Picture, Scene, Views
from nerf_lightning.dataset.rays import view_batch
from nerf_lightning.errors import NoRoom
from nerf_lightning.refine import summarize_corrections
from nerf_lightning.system import (
    RENDERED_PIXELS,
    NeRF3D,
    System,
    aligned_psnr,
    misfits,
    psnr_of_photos,
)
from nerf_lightning.utils.files import known, write_json
from nerf_lightning.utils.machine import describe_machine
from nerf_lightning.utils.signals import Interrupted
from nerf_lightning.utils.text import subsample

try:
    import resource
except ImportError:  # Windows has no such module; peak memory is then not reported
    resource = None  # type: ignore[assignment]

NO_BETTER = 1.0
"""A run has learned nothing if it is less than this many dB better than one plain colour ..."""
SEEN_AS_EQUAL = 40.0
"""... unless it reaches this many dB: then one colour may be all there is to learn."""


def peak_memory_bytes(device: torch.device) -> int | None:
    """The most memory this process has held so far; None if unknown.

    On CUDA, the peak of its tensors on the device; on MPS, which keeps no such count, what its driver holds now.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if device.type == "mps":
        return torch.mps.driver_allocated_memory()
    if resource is None:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def summarize(views: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Means over views, and the worst of them."""
    return {
        "psnr": statistic_of(views, fmean, "psnr"),
        "ssim": statistic_of(views, fmean, "ssim"),
        "psnr_worst_view": statistic_of(views, min, "psnr"),
    }


def statistic_of(views: Sequence[Mapping[str, float]], statistic: Callable[..., float], key: str) -> float | None:
    """A statistic over the views that have a finite figure; None where no view has."""
    values = [view[key] for view in views if math.isfinite(view[key])]
    return round(statistic(values), 4) if values else None


class Results(Renders):
    """Writes results.json after the test, and also when the run fails or is interrupted.

    Where the scene has a test split beside the held-out views, it is evaluated too: all of it, or as many views, evenly
    chosen, as there is time for.

    Args:
        path: the file, below the run folder.
        method: name of the model, as configured.
        seed: of the run.
        warnings: what was doubtful about the data before training began.
    """

    def __init__(self, path: str, method: str, seed: int, warnings: Sequence[str] = ()):
        self.path = path
        self.method = method
        self.seed = seed
        self.warnings = list(warnings)
        self.views: list[dict[str, float]] = []
        self.test_views: list[dict[str, float]] | None = None
        """Figures of the test split; None before it is evaluated."""
        self.aligned: list[float] = []
        """PSNR of held-out photos with their own corrections, where training photos had such."""
        self.misfits: list[dict[str, Any]] | None = None
        """Training photos that do not fit."""
        self.summary: dict[str, Any] = {}
        """What was written last."""

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        scene, system = data_of(trainer).scene, trainer.lightning_module
        if not isinstance(scene, Scene):
            return {}
        pixels = 0 if scene.test is None or self.test_views is not None else len(scene.test.pixels)
        corrected = isinstance(system, NeRF3D) and system.corrections is not None and system.corrections.enabled_at
        aligned = RENDERED_PIXELS * len(scene.val) if corrected and not self.aligned else 0
        one_view = pixels / len(scene.test) if scene.test is not None else 0
        return {"test": Need(pixels, one_view, scored=True), "aligned": Need(aligned, aligned / 8)}

    def evaluate_test(self, trainer: L.Trainer, system: System, views: Views) -> None:
        """Renders the test split."""
        share, plan = share_of(trainer, system, "test"), Budget.of(trainer).plan
        chosen = subsample(len(views), max(1, int(share * len(views))))
        found = []
        for number, view in enumerate(chosen, 1):
            with plan.rendering(f"test view {number} of {len(chosen)}"):
                (result,) = system.evaluate_views([view_batch(views, view)])
                found.append({"psnr": result.psnr, "ssim": result.ssim})
            plan.note(result.pixels, result.seconds)
        self.test_views = found

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.views, self.test_views = [], None

    def on_test_batch_end(self, trainer: L.Trainer, pl_module: System, outputs: Any, *batch: Any) -> None:
        self.views.append(outputs)

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        counted = [view for view in self.views if math.isfinite(view["psnr"])]
        quality, plain = (
            fmean(view[key] for view in counted) if counted else math.nan for key in ("psnr", "plain_psnr")
        )
        scene = data_of(trainer).scene
        if isinstance(pl_module, NeRF3D) and isinstance(scene, Scene):
            if pl_module.corrections is not None and pl_module.corrections.enabled_at:
                share = share_of(trainer, pl_module, "aligned")
                with Budget.of(trainer).plan.rendering("aligned held-out photos"):
                    self.aligned = aligned_psnr(pl_module, scene.val, share)
            if scene.test is not None:
                self.evaluate_test(trainer, pl_module, scene.test)
            by_photo = psnr_of_photos(pl_module, scene.train)
            self.misfits = [
                {"photo": scene.train.name(i), "number": i, "psnr": round(by_photo[i], 2)} for i in misfits(by_photo)
            ]
        nothing = min(plain + NO_BETTER, SEEN_AS_EQUAL)
        stopped = "stopped_early" if Budget.of(trainer).progress(trainer.global_step) < 1.0 else "finished"
        broken = (name for name, value in pl_module.named_parameters() if not value.isfinite().all())
        if name := next(broken, None):
            self.write(trainer, pl_module, "collapsed", f"{name} is no longer finite")
        elif not counted:
            diagnosis = "held-out views have no figure: what is rendered is not finite, or no pixel of theirs is known"
            self.write(trainer, pl_module, "collapsed", diagnosis)
        elif quality < nothing:
            found = pl_module.diagnose(data_of(trainer).held_out(0).to(pl_module.device))
            diagnosis = f"held-out PSNR {quality:.2f} dB is no better than one plain colour ({plain:.2f} dB)"
            self.write(trainer, pl_module, "collapsed", f"{diagnosis}: {found}" if found else diagnosis)
        else:
            diagnosis = gap(trainer, pl_module, quality) or wild_between(trainer, pl_module, nothing)
            self.write(trainer, pl_module, stopped, diagnosis)
        if trainer.logger is not None:
            scores = {"val/psnr": quality, "val/ssim": self.summary["ssim"] or 0.0}
            seconds = {TRAIN_SECONDS: self.summary["train_seconds"]}
            trainer.logger.log_metrics(scores | seconds, trainer.global_step)

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        if isinstance(exception, Interrupted | KeyboardInterrupt):
            if len(self.views) < data_of(trainer).held_out_views:
                self.views = []  # the mean of some views is another figure
            self.write(trainer, pl_module, "interrupted", f"at step {trainer.global_step}; resume= continues")
        elif (
            trainer.ckpt_path is None or Budget.of(trainer).state.clock.started
        ):  # else there was no state to go on from
            with suppress(NoRoom):  # on a full disk what happened first is to be told
                self.write(trainer, pl_module, "failed", " ".join(f"{type(exception).__name__}: {exception}".split()))

    def test_figures(self, scene: Scene | Picture) -> dict[str, float | int | None] | None:
        """Of the test split: means, the worst view, and how many views they are of; None without one."""
        if self.test_views is None or not isinstance(scene, Scene) or scene.test is None:
            return None
        counts = {"views": len(self.test_views), "views_in_split": len(scene.test)}
        return {**summarize(self.test_views), **counts}

    def write(self, trainer: L.Trainer, pl_module: System, status: str, diagnosis: str) -> None:
        """Writes the file with what is known so far; what was not measured is null."""
        scene, budget = data_of(trainer).scene, Budget.of(trainer)
        throughput, held_out = attached(trainer, Throughput), attached(trainer, HeldOut)
        guard = attached(trainer, Guard)
        curve = [] if held_out is None else [point for point in held_out.curve if math.isfinite(point[2])]

        figures = summarize(self.views)
        if figures["psnr"] is not None:
            curve = [*curve, [round(budget.seconds, 3), trainer.global_step, figures["psnr"]]]
        state = pl_module.state_dict().values()
        corrections = pl_module.corrections if isinstance(pl_module, NeRF3D) else None
        found = {
            "scene": scene.describe(),
            "background": pl_module.background,
            "method": self.method,
            "seed": self.seed,
            "device": str(pl_module.device),
            "threads": torch.get_num_threads(),
            "machine": describe_machine(pl_module.device),
            # Several processes would count each other as other work.
            "load": budget.state.clock.load.cores() if trainer.world_size == 1 else None,
            "versions": {
                "python": platform.python_version(),
                "torch": torch.__version__,
                "lightning": L.__version__,
                "numba": version("numba"),
                "nerf_lightning": nerf_lightning.__version__,
            },
            "parameters": sum(p.numel() for p in pl_module.parameters() if p.requires_grad),
            "artifact_bytes": sum(tensor.numel() * tensor.element_size() for tensor in state),
            "train_seconds": round(budget.seconds, 3),
            "steps": trainer.global_step,
            "rays_per_second": round(throughput.rays / budget.seconds, 1) if throughput and budget.seconds else None,
            **figures,
            "psnr_aligned": round(fmean(self.aligned), 4) if self.aligned else None,
            "rows_measured": None if held_out is None else round(held_out.rows, 4),
            "test": self.test_figures(scene),
            "render_seconds_per_view": statistic_of(self.views, median, "seconds"),
            "peak_memory_bytes": peak_memory_bytes(pl_module.device),
            "curve": curve,
            "warnings": self.warnings,
            "plateau": budget.stopped,
            "misfits": self.misfits,
            "corrections": summarize_corrections(corrections)
            if corrections is not None and corrections.is_finite
            else None,
            "recoveries": [asdict(one) for one in guard.recoveries] if guard is not None else [],
            "status": status,
            "diagnosis": diagnosis,
        }
        self.summary = known(found)
        if trainer.is_global_zero:
            write_json(Path(trainer.default_root_dir) / self.path, self.summary)
