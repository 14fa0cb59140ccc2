"""Adverse training conditions and methods of the stability suite, read from conf/stability.yaml."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import torch
import yaml

from nerf_lightning.config import conf_dir
from nerf_lightning.dataset.pixel_datamodule import Picture
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.synthetic import corruptions, objects
from nerf_lightning.synthetic.rooms import ROOMS, make_room_scene

UPSCALE_FACTOR = 2
"""Images have this many times the training pixels per side, so that 2D fields are also tested between them."""


@cache
def make_subject(seed: int) -> Scene:
    """The pile, shared by all seeds; never modified in place."""
    return objects.make_object_scene(objects.PILE)


def make_closeup(seed: int) -> Scene:
    """The pile, with held-out views closer than the training views."""
    scene = make_subject(0)
    cameras = objects.make_hemisphere_cameras(len(scene.val), scene.val.cameras.width, phase=0.7, distance=2.4)
    photos = objects.render_photos(objects.PILE, cameras, scene.background)
    return replace(scene, val=Views.from_images(photos, cameras))


def make_waves(width: int = 48, height: int = 48) -> Picture:
    """Color waves whose wavelength decreases from left to right, to six pixels of the training image.

    That image has `width` by `height` pixels; the returned one `UPSCALE_FACTOR` times as many per side.
    """
    across, down = ((np.arange(UPSCALE_FACTOR * side) + 0.5) / (UPSCALE_FACTOR * side) for side in (width, height))
    phase = np.pi * across**2 * width / 6
    waves = [np.sin(phase[None, :] + tilt * down[:, None]) for tilt in (0.0, 3.0, 9.0)]
    image = (127.5 + 110 * np.stack(waves, axis=-1)).round().astype(np.uint8)
    return Picture("waves", BUILT_IN, torch.from_numpy(image))


def make_uniform_image() -> Picture:
    return Picture("plain", BUILT_IN, torch.tensor([200, 120, 40], dtype=torch.uint8).expand(96, 96, 3).contiguous())


SCENES: dict[str, Callable[[int], Scene | Picture]] = {
    "pile": make_subject,
    "pile with alpha": lambda seed: objects.make_object_scene(objects.PILE, None),
    "pile seen from nearer": make_closeup,
    "marble on white": lambda seed: objects.make_object_scene(objects.MARBLE, (1.0, 1.0, 1.0)),
    "marble on black": lambda seed: objects.make_object_scene(objects.MARBLE),
    "rod": lambda seed: objects.make_object_scene(objects.ROD),
    "small subject": lambda seed: make_room_scene(ROOMS["small subject"], seed),
    "plain floor": lambda seed: make_room_scene(ROOMS["plain floor"], seed),
    "waves": lambda seed: make_waves(),
    "wide waves": lambda seed: make_waves(96, 16),
    "one color": lambda seed: make_uniform_image(),
}
IMAGE_SCENES = ("waves", "wide waves", "one color")


@dataclass(frozen=True)
class Condition:
    """An adverse training condition; conf/stability.yaml explains the fields."""

    name: str
    scene: str = "pile"
    corrupt: list[Any] = field(default_factory=list)
    options: list[str] = field(default_factory=list)
    by_kind: dict[str, list[str]] = field(default_factory=dict)
    lr_scale: float = 1.0
    is_unsolvable: bool = False
    max_loss_db: float | None = None
    control: bool = False
    quick: bool = False

    @property
    def is_2d(self) -> bool:
        return self.scene in IMAGE_SCENES

    @property
    def check(self) -> str:
        """The pass criterion in words."""
        if self.is_unsolvable:
            return "refused, or an alarm"
        return "no collapse" if self.max_loss_db is None else f"within {self.max_loss_db:g} dB of clean"

    def make(self, seed: int) -> Scene | Picture:
        """The scene or image of a seed."""
        scene = SCENES[self.scene](seed)
        if self.corrupt:
            name, *arguments = self.corrupt
            scene = getattr(corruptions, name)(scene, seed, *arguments)
        return scene


@dataclass(frozen=True)
class Method:
    """A model with its settings; conf/stability.yaml explains the fields."""

    kind: str
    options: list[str]
    is_2d: bool = False
    control: bool = False
    recovery_twin: str | None = None

    def get_options_for(self, condition: Condition) -> list[str] | None:
        """Config overrides; None if the condition does not apply."""
        if condition.by_kind and self.kind not in condition.by_kind:
            return None
        return [*self.options, *condition.options, *condition.by_kind.get(self.kind, [])]


_suite = yaml.safe_load((conf_dir() / "stability.yaml").read_text(encoding="utf-8"))
CONDITIONS = {entry["name"]: Condition(**entry) for entry in _suite["conditions"]}
METHODS = {name: Method(**entry) for name, entry in _suite["methods"].items()}
