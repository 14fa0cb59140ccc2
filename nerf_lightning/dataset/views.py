"""Views: photos of any sizes, what is masked in them, and the cameras that took them."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Cameras


@dataclass(frozen=True)
class Runs:
    """Stretches of known pixels, one after the other in `Views.pixels`; everything between them is masked."""

    starts: Int[Tensor, "S"]
    ends: Int[Tensor, "S"]
    """How many known pixels there are up to the end of each."""

    @classmethod
    def of(cls, known: Bool[Tensor, "N"]) -> "Runs":
        """The stretches of a mask."""
        edge = torch.cat([known.new_zeros(1), known, known.new_zeros(1)]).to(torch.int8).diff()
        starts, stops = ((edge == way).nonzero()[:, 0] for way in (1, -1))
        return cls(starts, (stops - starts).cumsum(0))

    def __len__(self) -> int:
        """Known pixels."""
        return int(self.ends[-1]) if len(self.ends) else 0

    def find(self, number: Int[Tensor, "R"]) -> Int[Tensor, "R"]:
        """Where the known pixels with these numbers lie."""
        run = torch.searchsorted(self.ends, number, right=True)
        return self.starts[run] + number - self.ends[run] + self.lengths[run]

    @property
    def lengths(self) -> Int[Tensor, "S"]:
        return self.ends.diff(prepend=self.ends.new_zeros(1))

    def to(self, device: torch.device) -> "Runs":
        return Runs(self.starts.to(device), self.ends.to(device))


@dataclass(frozen=True)
class Views:
    """Photos of any sizes, and the cameras that took them."""

    pixels: UInt8[Tensor, "N C"]
    """sRGB, photo after photo, each row by row; C is 3, or 4 with straight (not premultiplied) alpha."""
    cameras: Cameras
    known: Runs | None = None
    """Pixels that count; None for all of them."""
    names: tuple[str, ...] = ()
    """Of the photos' files; empty where they have none."""
    exposures: tuple[float, ...] = ()
    """Light that each photo gathered, in any unit; empty unless all files state it."""

    @classmethod
    def of(cls, images: UInt8[Tensor, "V H W C"], cameras: Cameras) -> "Views":
        """Photos of one size; no copy where they lie in memory one after the other."""
        return cls(images.reshape(-1, images.shape[3]), cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def channels(self) -> int:
        """3, or 4 with alpha."""
        return self.pixels.shape[1]

    @property
    def nbytes(self) -> int:
        """Of the pictures."""
        return self.pixels.nbytes

    @cached_property
    def starts(self) -> Int[Tensor, "V1"]:
        """Where each photo begins in `pixels`, and where the last ends."""
        return torch.cat([torch.zeros(1, dtype=torch.long), self.cameras.sizes.prod(1).cumsum(0)]).to(
            self.pixels.device
        )

    @cached_property
    def widths(self) -> Int[Tensor, "V"]:
        """Of each photo, in pixels, where the pixels are."""
        return self.cameras.sizes[:, 0].to(self.pixels.device)

    @cached_property
    def _cuts(self) -> list[int]:
        return self.starts.tolist()

    def image(self, view: int) -> UInt8[Tensor, "H W C"]:
        """One photo; no copy."""
        width, height = self.cameras.size(view)
        start = self._cuts[view]
        return self.pixels[start : start + width * height].view(height, width, -1)

    def name(self, view: int) -> str:
        """Of a photo's file, or its number."""
        return self.names[view] if self.names else f"photo {view}"

    @property
    def images(self) -> UInt8[Tensor, "V H W C"]:
        """All photos, where they have one size; no copy.

        Raises:
            ValueError: they have several.
        """
        return self.pixels.view(len(self), self.cameras.height, self.cameras.width, -1)

    @cached_property
    def mask(self) -> Bool[Tensor, "N"]:
        """Which pixels count."""
        if self.known is None:
            return torch.ones(len(self.pixels), dtype=torch.bool, device=self.pixels.device)
        edge = torch.zeros(len(self.pixels) + 1, dtype=torch.int8, device=self.pixels.device)
        edge[self.known.starts] = 1
        edge[self.known.starts + self.known.lengths] = -1
        return edge[:-1].cumsum(0, dtype=torch.int8).bool()

    def mask_of(self, view: int) -> Bool[Tensor, "H W"]:
        """Which pixels of a photo count."""
        width, height = self.cameras.size(view)
        start = self._cuts[view]
        return self.mask[start : start + width * height].view(height, width)

    def __getitem__(self, index: Tensor) -> "Views":
        """Some of the views; no copy of pixels where they follow each other."""
        chosen = index.tolist()
        parts = [slice(self._cuts[view], self._cuts[view + 1]) for view in chosen]
        if chosen and chosen == list(range(chosen[0], chosen[0] + len(chosen))):
            parts = [slice(parts[0].start, parts[-1].stop)]

        def take(values: Tensor) -> Tensor:
            return values[parts[0]] if len(parts) == 1 else torch.cat([values[:0], *(values[part] for part in parts)])

        pixels = take(self.pixels)
        known = None if self.known is None else Runs.of(take(self.mask))
        names = tuple(self.names[view] for view in chosen) if self.names else ()
        exposures = tuple(self.exposures[view] for view in chosen) if self.exposures else ()
        return Views(pixels, self.cameras[index], known, names, exposures)

    def spread(self, count: int) -> "Views":
        """At most `count` views, evenly spaced from the first to the last."""
        return self[torch.linspace(0, len(self) - 1, min(len(self), count)).round().long()]

    def to(self, device: torch.device) -> "Views":
        known = None if self.known is None else self.known.to(device)
        return Views(self.pixels.to(device), self.cameras.to(device), known, self.names, self.exposures)
