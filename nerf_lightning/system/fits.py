"""Training photos that the field does not explain as it does the others: a wrong pose, or something that moved."""

import torch
from torch import Tensor

from nerf_lightning.dataset import Views
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.system.trial import seen_by, some_pixels, squared_errors
from nerf_lightning.utils.seeding import Stream, step_generator

PIXELS = 256
"""Of each photo that are compared."""
SPREADS = 7.0
"""A photo stands out if it is this many robust standard deviations worse than the median ..."""
FAR_WORSE_DB = 6.0
"""... and this many dB."""


def psnr_of_photos(system: NeRF3D, views: Views) -> list[float]:
    """PSNR of each training photo in dB, by some of its pixels; nan where none of those is known.

    Cameras and light are taken as corrected, if they are.
    """
    views = views.to(system.device)
    generator = step_generator(system.seed, Stream.STUDY, 2, system.device)
    pixels = some_pixels(views, range(len(views)), PIXELS, system.renderer.background.color, generator)
    seen = seen_by(lambda rays, _: system.render(rays), system.corrections, pixels)
    squares = squared_errors(seen, system.corrections, pixels, len(views))
    known = pixels.known.view(len(views), -1).sum(1)
    return [mse_to_psnr(mse) for mse in (squares / (3 * known)).tolist()]


def misfits(psnrs: list[float]) -> list[int]:
    """Numbers of the photos that stand out, worst first.

    The spread of the others is 1.4826 times their median absolute deviation, as of a normal distribution.
    """
    values: Tensor = torch.tensor(psnrs, dtype=torch.float64)
    middle = values.nanmedian()
    spread = 1.4826 * (values - middle).abs().nanmedian()
    limit = float(middle - max(FAR_WORSE_DB, SPREADS * float(spread)))
    return sorted((i for i, value in enumerate(psnrs) if value < limit), key=psnrs.__getitem__)
