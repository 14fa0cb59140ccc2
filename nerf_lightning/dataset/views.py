"""Views: photos of any sizes with masks and cameras."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.utils.tensor_dataclass import TensorDataclass


@dataclass(frozen=True)
class Views(TensorDataclass):
    """Photos of any sizes with masks and cameras, as one flat array of pixels."""

    pixels: UInt8[Tensor, "N C"]
    """sRGB, concatenated photos in row-major order; C is 3, or 4 with straight (not premultiplied) alpha."""
    cameras: Cameras
    valid_mask: Bool[Tensor, "N"] | None = None
    """Unmasked pixels; None for all."""
    names: tuple[str, ...] = ()
    """File names, or empty."""
    exposures: tuple[float, ...] = ()
    """Exposure of each photo, in any unit; empty unless all files state it."""

    @classmethod
    def from_images(cls, images: UInt8[Tensor, "V H W C"], cameras: Cameras) -> "Views":
        """Views of photos of one size; no copy if contiguous."""
        return cls(images.reshape(-1, images.shape[3]), cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def channels(self) -> int:
        """3, or 4 with alpha."""
        return self.pixels.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of photos and masks."""
        return self.pixels.nbytes + (0 if self.valid_mask is None else self.valid_mask.nbytes)

    @cached_property
    def offsets(self) -> Int[Tensor, "V1"]:
        """Start of each photo in `pixels`, and the end of the last."""
        return torch.cat([torch.tensor([0]), self.cameras.sizes.prod(1).cumsum(0)]).to(self.pixels.device)

    @cached_property
    def widths(self) -> Int[Tensor, "V"]:
        """Photo widths in pixels, on the device of `pixels`."""
        return self.cameras.sizes[:, 0].to(self.pixels.device)

    @cached_property
    def _view_offsets(self) -> list[int]:
        return self.offsets.tolist()

    def image(self, view: int) -> UInt8[Tensor, "H W C"]:
        """One photo; no copy."""
        width, height = self.cameras.size(view)
        start = self._view_offsets[view]
        return self.pixels[start : start + width * height].view(height, width, -1)

    def name(self, view: int) -> str:
        """File name of a photo, or its index."""
        return self.names[view] if self.names else f"photo {view}"

    @property
    def images(self) -> UInt8[Tensor, "V H W C"]:
        """All photos of one size, without a copy.

        Raises:
            ValueError: the sizes differ.
        """
        return self.pixels.view(len(self), self.cameras.height, self.cameras.width, -1)

    @cached_property
    def mask(self) -> Bool[Tensor, "N"]:
        """Unmasked pixels."""
        if self.valid_mask is not None:
            return self.valid_mask
        return torch.ones(len(self.pixels), dtype=torch.bool, device=self.pixels.device)

    def sample_pixels(self, count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
        """Samples indices of unmasked pixels uniformly, with replacement."""
        device = self.pixels.device
        pixels = torch.randint(len(self.pixels), (count,), generator=generator, device=device)
        while self.valid_mask is not None and len(masked := (~self.valid_mask[pixels]).nonzero()[:, 0]):
            pixels[masked] = torch.randint(len(self.pixels), (len(masked),), generator=generator, device=device)
        return pixels

    def view_mask(self, view: int) -> Bool[Tensor, "H W"]:
        """Unmasked pixels of one photo."""
        width, height = self.cameras.size(view)
        start = self._view_offsets[view]
        return self.mask[start : start + width * height].view(height, width)

    def __getitem__(self, index: Tensor) -> "Views":
        """Selects views; no copy of pixels for consecutive ones."""
        chosen = index.tolist()
        parts = [slice(self._view_offsets[view], self._view_offsets[view + 1]) for view in chosen]
        if chosen and chosen == list(range(chosen[0], chosen[0] + len(chosen))):
            parts = [slice(parts[0].start, parts[-1].stop)]

        def take(values: Tensor) -> Tensor:
            return values[parts[0]] if len(parts) == 1 else torch.cat([values[:0], *(values[part] for part in parts)])

        pixels = take(self.pixels)
        valid = None if self.valid_mask is None else take(self.valid_mask)
        names = tuple(self.names[view] for view in chosen) if self.names else ()
        exposures = tuple(self.exposures[view] for view in chosen) if self.exposures else ()
        return Views(pixels, self.cameras[index], valid, names, exposures)

    def subsample(self, count: int) -> "Views":
        """At most `count` views, evenly spaced from the first to the last."""
        return self[torch.linspace(0, len(self) - 1, min(len(self), count)).round().long()]
