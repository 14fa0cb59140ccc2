"""results.json: everything a comparison needs to know about a run."""

import math
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from statistics import fmean
from typing import Any

import lightning as L
import torch

import nerf_lightning
from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.guard import Guard
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.callbacks.throughput import Throughput
from nerf_lightning.refine import summarize_corrections
from nerf_lightning.system import System
from nerf_lightning.utils.files import known
from nerf_lightning.utils.machine import describe_machine

NO_BETTER = 1.0
"""A run has learned nothing if it is less than this many dB better than one plain colour ..."""
SEEN_AS_EQUAL = 40.0
"""... unless it reaches this many dB: then one colour may be all there is to learn."""
WIDE_GAP = 8.0
"""A field has learned its photos rather than the scene if held-out views are this many dB worse than training photos ..."""
GOOD = 30.0
"""... unless they reach this many dB: then there is little to improve."""


def summarize_run(
    trainer: L.Trainer,
    system: System,
    method: str,
    seed: int,
    warnings: Sequence[str],
    error: BaseException | None = None,
) -> dict[str, Any]:
    """The content of results.json, with null for what was not measured.

    Args:
        trainer: after its test, or with an error.
        system: that it has trained.
        method: name of the model, as configured.
        seed: of the run.
        warnings: what was doubtful about the data before training began.
        error: what ended the run early.
    """
    device, budget = trainer.strategy.root_device, Budget.of(trainer)
    throughput, guard = attached(trainer, Throughput), attached(trainer, Guard)
    evaluation, corrections = attached(trainer, Evaluation) or Evaluation(), system.corrections
    status, diagnosis = judge_run(trainer, system, evaluation) if error is None else describe_error(trainer, error)
    results = {
        "scene": data_of(trainer).scene.describe(),
        "background": system.background,
        "method": method,
        "seed": seed,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "machine": describe_machine(device),
        # Several processes would count each other as other work.
        "load": budget.state.clock.load.cores() if trainer.world_size == 1 else None,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": L.__version__,
            "numba": version("numba"),
            "nerf_lightning": nerf_lightning.__version__,
        },
        "parameters": sum(p.numel() for p in system.parameters() if p.requires_grad),
        "artifact_bytes": artifact_bytes(system),
        "train_seconds": round(budget.seconds, 3),
        "steps": trainer.global_step,
        "rays_per_second": round(throughput.rays / budget.seconds, 1) if throughput and budget.seconds else None,
        **evaluation.figures,
        "curve": quality_curve(trainer),
        "warnings": list(warnings),
        "plateau": budget.stopped,
        "corrections": summarize_corrections(corrections) if corrections and corrections.is_finite else None,
        "recoveries": [asdict(one) for one in guard.recoveries] if guard is not None else [],
        "status": status,
        "diagnosis": diagnosis,
    }
    return known(results)


def describe_error(trainer: L.Trainer, error: BaseException) -> tuple[str, str]:
    """Status and diagnosis of a run that ended early."""
    if not isinstance(error, Exception):  # Ctrl-C, SIGTERM
        return "interrupted", f"at step {trainer.global_step}; resume= continues"
    return "failed", " ".join(f"{type(error).__name__}: {error}".split())


def judge_run(trainer: L.Trainer, system: System, evaluation: Evaluation) -> tuple[str, str]:
    """Status and diagnosis of a run that was trained and tested."""
    if name := next((name for name, value in system.named_parameters() if not value.isfinite().all()), None):
        return "collapsed", f"{name} is no longer finite"
    counted = [view for view in evaluation.views if math.isfinite(view["psnr"])]
    if not counted:
        return "collapsed", "no figure of held-out views: what is rendered is not finite, or no pixel is known"
    quality, plain = (fmean(view[key] for view in counted) for key in ("psnr", "plain_psnr"))
    view, nothing = data_of(trainer).held_out(0).to(system.device), min(plain + NO_BETTER, SEEN_AS_EQUAL)
    if quality < nothing:
        diagnosis = f"held-out PSNR {quality:.2f} dB is no better than one plain colour ({plain:.2f} dB)"
        return "collapsed", ": ".join(filter(None, (diagnosis, system.diagnose(view))))
    status = "stopped_early" if Budget.of(trainer).progress(trainer.global_step) < 1.0 else "finished"
    trained = [psnr for psnr in evaluation.photos if math.isfinite(psnr)]
    if trained and quality < min(fmean(trained) - WIDE_GAP, GOOD):
        return status, (
            f"training photos {fmean(trained):.1f} dB, held-out views {quality:.1f} dB: too few views for this model,"
            " or poses that do not fit their photos"
        )
    between = system.between(view)
    if between is not None and between < nothing:
        return status, (
            f"between its pixels the field is no better than one plain colour ({between:.1f} dB):"
            " it holds frequencies that the pixels do not show"
        )
    return status, ""


def quality_curve(trainer: L.Trainer) -> list[list[float]]:
    """[training seconds, step, PSNR] at each measurement, and at the end."""
    held_out, evaluation = attached(trainer, HeldOut), attached(trainer, Evaluation)
    final = evaluation.figures["psnr"] if evaluation is not None else None
    end = [] if final is None else [[round(Budget.of(trainer).seconds, 3), trainer.global_step, final]]
    return [*(held_out.curve if held_out is not None else []), *end]


def artifact_bytes(system: System) -> int:
    """Of all weights and buffers."""
    return sum(tensor.numel() * tensor.element_size() for tensor in system.state_dict().values())
