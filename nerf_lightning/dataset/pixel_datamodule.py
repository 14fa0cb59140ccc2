"""PixelDataModule: pixel coordinates of a picture and their colors."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.dataset.datamodule import StepDataModule
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.utils.option_checks import Count
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.tensor_dataclass import TensorDataclass

DEFAULT_PIXELS = 8192
"""Pixels per step, except for large pictures."""
MIN_PIXEL_FRACTION = 1 / 128
"""Minimum batch size as a fraction of the picture: the optimizer updates all parameters, of which large pictures have many.
On 16 million pixels, 777 steps of 8192 gave 34.6 dB and, in the same time, 496 of 131,072 gave 39.9."""


def no_larger_picture(width: int, height: int) -> None:
    """Default `Picture.make_reference`: larger versions are unknown."""


@dataclass(frozen=True)
class Picture:
    """One picture to fit."""

    name: str
    source: str
    image: UInt8[Tensor, "H W 3"]
    """sRGB."""
    make_reference: Callable[[int, int], UInt8[Tensor, "h w 3"] | None] = no_larger_picture
    """(width, height) -> ground truth at that size, or None if unknown."""
    test: ClassVar[None] = None
    """No test split."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width, _ = self.image.shape
        return width, height

    def sha256(self) -> str:
        """Hash of shape and pixels."""
        return hashlib.sha256(repr(tuple(self.image.shape)).encode() + self.image.numpy().tobytes()).hexdigest()

    def describe(self) -> dict[str, object]:
        """Metadata of the picture for results.json."""
        return {
            "name": self.name,
            "source": self.source,
            "sha256": self.sha256(),
            "views": {"train": 1, "val": 1},
            "resolution": list(self.size),
        }


@dataclass(frozen=True)
class PixelBatch(TensorDataclass):
    """N pixel coordinates and their colors."""

    uv: Float[Tensor, "N 2"]
    """In [0, 1]^2, x right, y down; the center of pixel (row, col) is ((col + 0.5) / W, (row + 0.5) / H)."""
    rgb: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class PictureBatch(PixelBatch):
    """Pixels of a picture, row-major; N = height * width."""

    height: int
    width: int
    strip: int | None = None
    """See `PixelSubset.strip`."""
    valid_mask: ClassVar[None] = None
    """All pixels count."""


def pixel_grid(height: int, width: int, subset: PixelSubset = ALL_PIXELS) -> Float[Tensor, "N 2"]:
    """Pixel centers, row-major, see `PixelBatch.uv`."""
    rows, columns = subset.grid(width, height)
    x, y = (columns + 0.5) / width, (rows + 0.5) / height
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).view(-1, 2)


class PixelDataModule(StepDataModule[Tensor]):
    """Pixel batches for NeRF2D. Nothing is held out: quality is measured on all pixels.

    Args:
        scene: picture to fit.
        pixels: batch size over all processes, sampled with replacement; None: 8192, or 1/128 of pictures above a
            megapixel.
        seed: random seed of the sampling.
    """

    is_posed = False
    num_held_out_views = 1

    def __init__(self, scene: Picture, pixels: Count | None = None, seed: int = 0):
        super().__init__(scene.image, seed)
        self.scene = scene
        self.pixels = pixels or max(DEFAULT_PIXELS, round(MIN_PIXEL_FRACTION * self.count_held_out_pixels(0)))

    def scale_batch(self, factor: int) -> None:
        """Multiplies the batch size, for larger devices. Call before training."""
        self.pixels *= factor

    def draw_batch(self, photos: UInt8[Tensor, "H W 3"], step: int, part: slice) -> PixelBatch:
        generator = step_generator(self.seed, Stream.BATCH, step, photos.device)
        height, width, _ = photos.shape
        index = torch.randint(height * width, (self.pixels,), generator=generator, device=photos.device)[part]
        uv = torch.stack([(index % width + 0.5) / width, (index // width + 0.5) / height], dim=-1)
        return PixelBatch(uv, photos.view(-1, 3)[index].float() / 255)

    def make_warmup_batch(self) -> PixelBatch:
        """A small random batch for compiling kernels."""
        return PixelBatch(*torch.rand(64, 5, generator=step_generator(0, Stream.BATCH, 0)).split([2, 3], dim=1))

    def make_baseline_batch(self) -> PixelBatch:
        """All pixels, see `RayDataModule.make_baseline_batch`."""
        return self.get_held_out_view(0)

    def count_held_out_pixels(self, view: int) -> int:
        width, height = self.scene.size
        return width * height

    def get_held_out_view(self, view: int, subset: PixelSubset = ALL_PIXELS) -> PictureBatch:
        """Loads the picture, or a subset of its pixels."""
        width, height = self.scene.size
        rows, columns = subset.grid(width, height)
        rgb = self.scene.image[rows][:, columns].view(-1, 3).float().div_(255)  # in place: large pictures
        return PictureBatch(pixel_grid(height, width, subset), rgb, len(rows), len(columns), subset.strip)
