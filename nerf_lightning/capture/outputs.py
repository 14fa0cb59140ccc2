"""What a capture writes: the scene, with `cameras.json` and `calibration.yaml` beside it."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from nerf_lightning.capture.pack import pack
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic, write_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Placed:
    """A photo with its camera, or the reason why it has none."""

    name: str
    reason: str = ""
    """Why it was left out; "" if it was placed."""
    c2w: Float[np.ndarray, "4 4"] | None = None
    """OpenCV frame, metres."""
    reprojection_px: float | None = None
    by: str = ""
    """"texture" if it shows no tag, and was placed against the photos that do; "" if as the others."""

    @property
    def status(self) -> str:
        return "left out" if self.c2w is None else "placed"


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
        """Refuses, before long work, an orbit through a photo that is not there."""
        if self.orbit is not None and self.orbit not in [path.name for path in photos]:
            raise InputError("config", "orbit", self.orbit, f"a photo's name, such as {photos[0].name}")


def write_scene(folder: Path, photos: list[Placed], lens: Lens, packing: Packing, calibration: dict[str, Any]) -> Scene:
    """Packs the placed photos of a folder and writes everything.

    Args:
        folder: where the photos are.
        photos: all of them; a warning names each that was left out.
        lens: of the photos as they are.
        packing: the scene to write.
        calibration: what `calibration.yaml` says besides the lens.

    Raises:
        InputError: see `pack`.
    """
    for photo in photos:
        if photo.c2w is None:
            log.warning("%s left out: %s", photo.name, photo.reason)
    c2w = {folder / photo.name: photo.c2w for photo in photos if photo.c2w is not None}
    name = packing.name or packing.output.stem
    scene = pack(
        list(c2w),
        np.stack(list(c2w.values())),
        lens,
        name,
        str(folder),
        packing.longest,
        packing.holdout,
        packing.orbit,
    )
    save_npz(scene, packing.output)
    K = scene.train.cameras.K[0].tolist()  # of the undistorted, resized pictures
    entries = [
        {
            "name": photo.name,
            "status": photo.status,
            "reason": photo.reason,
            "K": None if photo.c2w is None else K,
            "c2w": None if photo.c2w is None else photo.c2w.tolist(),
            "reprojection_px": photo.reprojection_px,
            **({"by": photo.by} if photo.by else {}),
        }
        for photo in photos
    ]
    write_json(packing.output.with_name("cameras.json"), {"photos": entries})
    content = {
        **{key: getattr(lens, key) for key in ("width", "height")},
        **{key: float(getattr(lens, key)) for key in ("fx", "fy", "cx", "cy")},
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), map(float, lens.distortion), strict=True)),
        **calibration,
    }
    with atomic(packing.output.with_name("calibration.yaml")) as temporary:
        temporary.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")
    return scene
