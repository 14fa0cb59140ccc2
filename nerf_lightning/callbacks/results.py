"""results.json: metrics and metadata of a run, for comparisons."""

import math
import platform
from dataclasses import asdict
from importlib.metadata import version
from statistics import fmean
from typing import Any

import lightning as L
import torch

import nerf_lightning
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.divergence_recovery import DivergenceRecovery
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.throughput import Throughput
from nerf_lightning.callbacks.trainer_access import find_callback, get_datamodule
from nerf_lightning.callbacks.validation import PeriodicValidation
from nerf_lightning.refine import summarize_corrections
from nerf_lightning.system import System
from nerf_lightning.utils.files import nan_to_none
from nerf_lightning.utils.machine import describe_machine

MIN_GAIN_DB = 1.0
"""A run has learned nothing if it is less than this many dB better than a constant color ..."""
TRIVIAL_SCENE_DB = 40.0
"""... unless it reaches this PSNR: then one color may be all there is to learn."""
OVERFIT_GAP_DB = 8.0
"""A field overfits its photos if held-out views are this many dB worse than training photos ..."""
GOOD_PSNR_DB = 30.0
"""... unless they reach this PSNR: then there is little to improve."""


def summarize_run(
    trainer: L.Trainer, system: System, method: str, seed: int, warnings: list[str], error: BaseException | None = None
) -> dict[str, Any]:
    """Content of results.json, with null for what was not measured.

    Args:
        trainer: after its test, or with an error.
        system: the trained system.
        method: name of the model, as configured.
        seed: of the run.
        warnings: issues found in the data before training.
        error: what ended the run early.
    """
    device, budget = trainer.strategy.root_device, Budget.find(trainer)
    throughput, recovery = find_callback(trainer, Throughput), find_callback(trainer, DivergenceRecovery)
    evaluation, corrections = find_callback(trainer, Evaluation) or Evaluation(), system.corrections
    status, diagnosis = diagnose_run(trainer, system, evaluation) if error is None else describe_error(trainer, error)
    results = {
        "scene": get_datamodule(trainer).scene.describe(),
        "background": system.background,
        "method": method,
        "seed": seed,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "machine": describe_machine(device),
        # Several processes would count each other as background load.
        "load": budget.state.clock.load.average_cores() if trainer.world_size == 1 else None,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": L.__version__,
            "numba": version("numba"),
            "nerf_lightning": nerf_lightning.__version__,
        },
        "parameters": sum(p.numel() for p in system.parameters() if p.requires_grad),
        "artifact_bytes": count_artifact_bytes(system),
        "train_seconds": round(budget.seconds, 3),
        "steps": trainer.global_step,
        "rays_per_second": round(throughput.rays / budget.seconds, 1) if throughput and budget.seconds else None,
        **evaluation.metrics,
        "curve": collect_quality_curve(trainer),
        "warnings": warnings,
        "plateau": budget.final_plateau,
        "corrections": summarize_corrections(corrections) if corrections and corrections.is_finite else None,
        "recoveries": [asdict(restart) for restart in recovery.recoveries] if recovery is not None else [],
        "status": status,
        "diagnosis": diagnosis,
    }
    return nan_to_none(results)


def describe_error(trainer: L.Trainer, error: BaseException) -> tuple[str, str]:
    """Status and diagnosis of a run that ended early."""
    if not isinstance(error, Exception):  # Ctrl-C, SIGTERM
        return "interrupted", f"at step {trainer.global_step}; resume= continues"
    return "failed", " ".join(f"{type(error).__name__}: {error}".split())


def diagnose_run(trainer: L.Trainer, system: System, evaluation: Evaluation) -> tuple[str, str]:
    """Status and diagnosis of a run that was trained and tested."""
    if name := next((name for name, value in system.named_parameters() if not value.isfinite().all()), None):
        return "collapsed", f"{name} is no longer finite"
    finite_views = [view for view in evaluation.view_metrics if math.isfinite(view["psnr"])]
    if not finite_views:
        return "collapsed", "no PSNR of held-out views: their renders are not finite, or no pixel is known"
    held_out_psnr = fmean(view["psnr"] for view in finite_views)
    constant_psnr = fmean(view["constant_color_psnr"] for view in finite_views)
    min_useful_psnr = min(constant_psnr + MIN_GAIN_DB, TRIVIAL_SCENE_DB)
    view = get_datamodule(trainer).get_held_out_view(0).to(system.device)
    if held_out_psnr < min_useful_psnr:
        cause = f"held-out PSNR {held_out_psnr:.2f} dB is no better than a constant color ({constant_psnr:.2f} dB)"
        return "collapsed", ": ".join(filter(None, (cause, system.diagnose(view))))
    status = "stopped_early" if Budget.find(trainer).progress(trainer.global_step) < 1.0 else "finished"
    trained = [psnr for psnr in evaluation.photo_psnrs if math.isfinite(psnr)]
    if trained and held_out_psnr < min(fmean(trained) - OVERFIT_GAP_DB, GOOD_PSNR_DB):
        return status, (
            f"training photos {fmean(trained):.1f} dB, held-out views {held_out_psnr:.1f} dB: too few views for this model,"
            " or poses that do not fit their photos"
        )
    off_grid_psnr = system.measure_off_grid_psnr(view)
    if off_grid_psnr is not None and off_grid_psnr < min_useful_psnr:
        return status, (
            f"off the pixel grid the field is no better than a constant color ({off_grid_psnr:.1f} dB):"
            " it holds frequencies that the pixels do not show"
        )
    return status, ""


def collect_quality_curve(trainer: L.Trainer) -> list[list[float]]:
    """Quality curve: [training seconds, step, PSNR] at each validation and at the end."""
    validation, evaluation = find_callback(trainer, PeriodicValidation), find_callback(trainer, Evaluation)
    final = evaluation.metrics["psnr"] if evaluation is not None else None
    end = [] if final is None else [[round(Budget.find(trainer).seconds, 3), trainer.global_step, final]]
    return [*(validation.curve if validation is not None else []), *end]


def count_artifact_bytes(system: System) -> int:
    """Size in bytes of all weights and buffers."""
    return sum(tensor.numel() * tensor.element_size() for tensor in system.state_dict().values())
