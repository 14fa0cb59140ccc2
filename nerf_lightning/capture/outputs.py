"""What a capture writes: the scene, and `cameras.json` beside it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.pack import pack
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import write_json


@dataclass(frozen=True)
class Placed:
    """What became of one photo."""

    name: str
    status: str
    """placed, or left out."""
    reason: str
    """Why it was left out; "" where it was not."""
    c2w: Float[np.ndarray, "4 4"] | None
    reprojection_px: float | None


@dataclass(frozen=True)
class Packing:
    """How placed photos become a scene; see `pack`."""

    output: Path
    """The .npz to write."""
    longest: int | None = 300
    holdout: int = 10
    orbit: str | None = None
    name: str | None = None
    """Of the scene; None takes the output's."""

    def __post_init__(self) -> None:
        if self.output.suffix != ".npz":
            raise InputError("config", "output", str(self.output), "a file name that ends in .npz")

    def check(self, photos: Sequence[Path]) -> None:
        """Before long work: whether the photo that the orbit goes through is among those to be placed.

        Raises:
            InputError: where it is not.
        """
        if self.orbit is not None and self.orbit not in [path.name for path in photos]:
            raise InputError("config", "orbit", self.orbit, f"a photo's name, such as {photos[0].name}")


def write_scene(folder: Path, photos: list[Placed], lens: Lens, packing: Packing) -> Scene:
    """Packs the placed photos of a folder and writes the scene and `cameras.json`.

    Raises:
        InputError: see `pack`.
    """
    kept = [(folder / photo.name, photo.c2w) for photo in photos if photo.c2w is not None]
    scene = pack(
        [path for path, _ in kept],
        np.stack([c2w for _, c2w in kept]),
        lens,
        packing.name or packing.output.stem,
        str(folder),
        packing.longest,
        packing.holdout,
        packing.orbit,
    )
    save_npz(scene, packing.output)
    K = scene.train.cameras.K[0].tolist()
    write_json(packing.output.with_name("cameras.json"), {"photos": [_entry(photo, K) for photo in photos]})
    return scene


def _entry(photo: Placed, K: list[list[float]]) -> dict[str, Any]:
    """A photo as `cameras.json` holds it: K of the undistorted, resized picture; c2w in the OpenCV frame, metres."""
    entry = asdict(photo)
    entry["c2w"] = None if photo.c2w is None else photo.c2w.tolist()
    entry["K"] = None if photo.c2w is None else K
    return {key: entry[key] for key in ("name", "status", "reason", "K", "c2w", "reprojection_px")}


def lens_entry(lens: Lens) -> dict[str, Any]:
    """The lens as `calibration.yaml` holds it: of the photos as they are, pixel centres at +0.5."""
    distortion = (float(k) for k in lens.distortion)
    return {
        "width": lens.width,
        "height": lens.height,
        **{key: float(getattr(lens, key)) for key in ("fx", "fy", "cx", "cy")},
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=True)),
    }
