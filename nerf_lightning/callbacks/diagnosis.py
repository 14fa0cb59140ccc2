"""Why a held-out figure is worse than training promised."""

import math

import lightning as L

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.guard import Guard
from nerf_lightning.dataset import PictureBatch
from nerf_lightning.system import NeRF2D, System, mse_to_psnr

WIDE_GAP = 8.0
"""A field has learned its photos rather than the scene if held-out views are this many dB worse than training pixels ..."""
GOOD = 30.0
"""... unless they reach this many dB: then there is little to improve."""


def gap(trainer: L.Trainer, system: System, quality: float) -> str:
    """Explains a held-out PSNR far below that of the training pixels; "" if it is not, is unknown, or for a picture."""
    if isinstance(system, NeRF2D):
        return ""
    guard = attached(trainer, Guard)
    loss = guard.monitor.history.ema_loss if guard is not None else None
    if not loss or not math.isfinite(loss):
        return ""
    trained = mse_to_psnr(loss)
    if trained < quality + WIDE_GAP or quality >= GOOD:
        return ""
    return (
        f"training pixels {trained:.1f} dB, held-out views {quality:.1f} dB: too few views for this model,"
        " or poses that do not fit their photos"
    )


def wild_between(trainer: L.Trainer, system: System, nothing: float) -> str:
    """Explains a 2D field that is below `nothing` (dB) between its pixels; "" if it is not."""
    if not isinstance(system, NeRF2D):
        return ""
    view = data_of(trainer).held_out(0).to(system.device)
    assert isinstance(view, PictureBatch)  # what a NeRF2D is fed
    between = system.between(view)
    if between is None or between >= nothing:
        return ""
    return (
        f"between its pixels the field is no better than one plain colour ({between:.1f} dB):"
        " it holds frequencies that the pixels do not show"
    )
