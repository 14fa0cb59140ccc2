"""Scene: posed photos, split into training and held-out views, in one frame and one unit."""

import hashlib
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, find_typical_view
from nerf_lightning.dataset.views import Views

BUILT_IN = "built-in"
"""The source of what this package makes itself."""


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
    to_source: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    """Similarity from this scene's frame to the file's own, so that exports keep the original place and scale. In double
    precision: georeferenced files have coordinates of millions of metres."""
    test: Views | None = None
    """Held out, and measured on at the end alone, where a format has both."""
    kind: str = ""
    """Why the scene is bounded or unbounded, in a few words, and how its cameras are laid out."""
    points: Float[Tensor, "P 3"] | None = None
    """Some places on surfaces, in this frame, where a file brings them or photos were matched: for maps."""

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height in pixels of the commonest training photo."""
        return self.train.cameras.size(find_typical_view(self.train.cameras))

    def sha256(self) -> str:
        """A fingerprint of the pictures and their split, the same for every file format that holds them."""
        digest = hashlib.sha256()
        for views in (self.train, self.val):
            digest.update(repr((views.cameras.sizes.tolist(), views.channels)).encode())
            digest.update(views.pixels.numpy().data)
            if views.valid_mask is not None:
                digest.update(views.valid_mask.numpy().data)
        return digest.hexdigest()

    def describe(self) -> dict[str, object]:
        """Which scene this is, for results.json."""
        return {
            "name": self.name,
            "source": self.source,
            "sha256": self.sha256(),
            "views": {name: len(getattr(self, name) or ()) for name in ("train", "val", "test")},
            "resolution": list(self.resolution),
            "bounded": not self.bounds.unbounded,
            "kind": self.kind,
        }
