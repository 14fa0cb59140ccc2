"""Scene: posed photos, split into training and held-out views, in one frame and one unit."""

import hashlib
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras

BUILT_IN = "built-in"
"""The source of what this package makes itself."""


@dataclass(frozen=True)
class Views:
    """Photos and the cameras that took them, all of one size."""

    images: UInt8[Tensor, "V H W C"]
    """sRGB; C is 3, or 4 with straight (not premultiplied) alpha."""
    cameras: Cameras

    def __len__(self) -> int:
        return self.images.shape[0]

    @property
    def nbytes(self) -> int:
        """Of the pictures."""
        return self.images.nbytes

    def __getitem__(self, index: Tensor) -> "Views":
        """Some of the views."""
        return Views(self.images[index], self.cameras[index])

    def spread(self, count: int) -> "Views":
        """At most `count` views, evenly spaced from the first to the last."""
        return self[torch.linspace(0, len(self) - 1, min(len(self), count)).round().long()]

    def to(self, device: torch.device) -> "Views":
        return Views(self.images.to(device), self.cameras.to(device))


@dataclass(frozen=True)
class Scene:
    """What a run trains on."""

    name: str
    """A short word for file names and captions, "lego" or "bricks"."""
    source: str
    """Where it came from: a path, or `BUILT_IN`."""
    train: Views
    val: Views
    """Held out: never trained on."""
    orbit: Cameras
    """A path to show the result along."""
    bounds: Bounds
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The colour behind the content: baked into images without alpha, the convention for images with it."""
    to_source: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    """Similarity from this scene's frame to the file's own, so that exports keep the original place and scale."""

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height of a view in pixels."""
        return self.train.cameras.width, self.train.cameras.height

    def sha256(self) -> str:
        """A fingerprint of the pictures and their split, the same for every file format that holds them."""
        digest = hashlib.sha256()
        for views in (self.train, self.val):
            digest.update(repr(tuple(views.images.shape)).encode())
            for image in views.images:  # one by one: bytes are a copy
                digest.update(image.numpy().tobytes())
        return digest.hexdigest()

    def describe(self) -> dict[str, object]:
        """Which scene this is, for results.json."""
        return {
            "name": self.name,
            "source": self.source,
            "sha256": self.sha256(),
            "views": {"train": len(self.train), "val": len(self.val)},
            "resolution": list(self.resolution),
        }
