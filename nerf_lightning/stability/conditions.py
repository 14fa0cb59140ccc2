"""Conditions under which methods are known to fail, each with the check that decides."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch

from nerf_lightning.dataset.pixels import Picture
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.stability import damage
from nerf_lightning.stability.rooms import ROOMS, indoors
from nerf_lightning.stability.toys import MARBLE, PILE, ROD, around, photograph, toy

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
LARGER = 2
"""Pictures have this many times the pixels that are trained on along each side, so that a field is judged between them too."""
MakeScene = Callable[[int], Scene | Picture]
"""Makes a 3D scene or a 2D picture from a seed."""


@dataclass(frozen=True)
class Condition:
    """One way to make training hard."""

    name: str
    check: str
    """What must hold, in words."""
    scene: MakeScene
    options: tuple[str, ...] = ()
    """Overrides for all methods."""
    by_method: tuple[tuple[str, str], ...] = ()
    """(kind, override): if there are any, the condition applies to methods of these kinds alone."""
    rate: float = 1.0
    """Factor on the learning rate."""
    hopeless: bool = False
    """Whether no method can work: training must be refused, or at least warn."""
    flat: bool = False
    """Whether it is 2D."""
    loses: float | None = None
    """dB that a method may lose against its own clean run; None if only a collapse is a failure."""
    control: bool = False
    """Whether it must fail: a suite in which nothing fails proves nothing."""

    def options_for(self, kind: str) -> list[str] | None:
        """Overrides for a kind of model; None if the condition does not apply to it."""
        own = [option for name, option in self.by_method if name == kind]
        return None if self.by_method and not own else [*self.options, *own]


@cache
def _pile(seed: int = 0) -> Scene:
    """The same for every seed; nobody changes it in place."""
    return toy(PILE)


def picture(width: int = 48, height: int = 48) -> Picture:
    """Waves in three colours that grow shorter from left to right, down to six pixels of the picture that is trained on.

    That one is `width` by `height`; this one has `LARGER` times as many pixels along each side.
    """
    across, down = ((np.arange(LARGER * side) + 0.5) / (LARGER * side) for side in (width, height))
    phase = np.pi * across**2 * width / 6
    waves = [np.sin(phase[None, :] + tilt * down[:, None]) for tilt in (0.0, 3.0, 9.0)]
    image = (127.5 + 110 * np.stack(waves, axis=-1)).round().astype(np.uint8)
    return Picture("waves", BUILT_IN, torch.from_numpy(image))


def _one_colour(seed: int) -> Picture:
    return Picture("plain", BUILT_IN, torch.tensor([200, 120, 40], dtype=torch.uint8).expand(96, 96, 3).contiguous())


def _damaged(change: Callable[..., Scene], *how: object) -> MakeScene:
    return lambda seed: change(_pile(), seed, *how)


def _waves(seed: int) -> Picture:
    return picture()


def _seen_from_nearer(seed: int) -> Scene:
    scene = _pile()
    cameras = around(len(scene.val), scene.val.cameras.width, phase=0.7, distance=2.4)
    return replace(scene, val=Views.of(photograph(PILE, cameras, BLACK), cameras))


def _room(name: str) -> MakeScene:
    return lambda seed: indoors(ROOMS[name], seed)


SURVIVES, TOLD = "no collapse", "refused, or an alarm"
NETWORKS = ("mlp", "hashgrid", "tensorf")
GRIDS = ("hashgrid", "voxels", "tensorf")
CORRECTED = ("refine=auto",)
CAPTURE = tuple(
    f"renderer.{name}_loss_weight={weight}"
    for name, weight in (("distortion", 0.001), ("near", 0.02), ("view", "suited"))
)
"""How photos with a background are trained."""
CAPTURED = (*((method, "sampler=proposal") for method in GRIDS), ("hashgrid", "model.split_colour=true"))

CONDITIONS = (
    Condition("clean", "the yardstick of all others", _pile),
    Condition("white, small object", SURVIVES, lambda seed: toy(MARBLE, WHITE)),
    Condition("black, small object", SURVIVES, lambda seed: toy(MARBLE, BLACK)),
    Condition("alpha on random colours", SURVIVES, lambda seed: toy(PILE, None), ("renderer.background=random",), loses=3),
    Condition("wrong background flag", TOLD, _damaged(damage.with_background, WHITE), hopeless=True),
    *(
        Condition(f"rate x{factor}", "no collapse, the guard may act", _pile, rate=factor)
        for factor in (3, 10, 30)
    ),
    *(
        Condition(f"{kind} density", SURVIVES, _pile, by_method=tuple((m, f"model.density={kind}") for m in NETWORKS))
        for kind in ("relu", "softplus")
    ),
    *(
        Condition(f"{count} views", f"{SURVIVES}; the gap is told", _damaged(damage.with_views, count))
        for count in (3, 6, 12)
    ),
    Condition(
        "all frequencies, 4 views", SURVIVES, _damaged(damage.with_views, 4),
        by_method=(("mlp", "model.position_frequencies=16"),),
    ),
    Condition("near/far x0.1", TOLD, _damaged(damage.with_limits, 0.1), hopeless=True),
    Condition("near/far x10", TOLD, _damaged(damage.with_limits, 10.0), hopeless=True),
    *(
        Condition(f"world x{factor:g}", "within 1 dB of clean", _damaged(damage.scaled, factor), loses=1.0)
        for factor in (0.1, 10.0)
    ),
    Condition("OpenGL poses", TOLD, _damaged(damage.turned_to_opengl), hopeless=True),
    Condition("shuffled poses", TOLD, _damaged(damage.shuffled), hopeless=True),
    *(
        Condition(f"pose noise {degrees:g} deg", SURVIVES, _damaged(damage.with_pose_noise, degrees))
        for degrees in (0.5, 2.0, 5.0)
    ),
    Condition("exposure +-30%", SURVIVES, _damaged(damage.with_exposure_drift, 0.3)),
    *(
        Condition(f"pose noise {degrees:g} deg, corrected", SURVIVES, _damaged(damage.with_pose_noise, degrees), CORRECTED)
        for degrees in (0.5, 2.0, 5.0)
    ),
    Condition("exposure +-30%, corrected", SURVIVES, _damaged(damage.with_exposure_drift, 0.3), CORRECTED),
    Condition("clean, nothing to correct", "within 1 dB of clean", _pile, CORRECTED, loses=1.0),
    Condition("image noise 0.1", SURVIVES, _damaged(damage.with_noise, 0.1)),
    Condition("thin rod", SURVIVES, lambda seed: toy(ROD)),
    Condition("occupancy emptied", SURVIVES, _pile, by_method=tuple((m, "sampler.threshold=1000") for m in GRIDS)),
    Condition("content outside the box", TOLD, _damaged(damage.with_box, 0.3), hopeless=True),
    Condition("box x4", SURVIVES, _damaged(damage.with_box, 4.0)),
    Condition(
        "grid too coarse", SURVIVES, _pile,
        by_method=(
            ("hashgrid", "model.finest=16"), ("voxels", "model.finest=40"), ("tensorf", "model.finest=64"),
        ),
    ),
    Condition("grid too fine", SURVIVES, _pile, by_method=tuple((m, "model.finest=256") for m in GRIDS)),
    Condition("tiny hash table", SURVIVES, _pile, by_method=(("hashgrid", "model.log2_entries=8"),)),
    Condition("seen from nearer", SURVIVES, _seen_from_nearer),
    *(
        Condition(name, SURVIVES, _room(room), CAPTURE, CAPTURED)
        for name, room in (("small subject in a room", "small subject"), ("plain floor", "plain floor"))
    ),
    Condition("half precision", SURVIVES, _pile, ("trainer.precision=bf16-mixed",)),
    Condition("2D: clean", "the yardstick of all others in 2D", _waves, flat=True),
    Condition("2D: one colour", SURVIVES, _one_colour, flat=True),
    Condition("2D: 96 x 16 pixels", SURVIVES, lambda seed: picture(96, 16), flat=True),
    *(Condition(f"2D: rate x{factor}", SURVIVES, _waves, rate=factor, flat=True) for factor in (3, 10, 30)),
    Condition(
        "2D: L = 40", "within 3 dB of clean", _waves, by_method=(("picture_mlp", "model.frequencies=40"),), flat=True, loses=3,
        control=True,
    ),
    Condition(
        "2D: SIREN far out of [-1, 1]", "within 3 dB of clean", _waves, by_method=(("siren", "model.reach=10"),), flat=True,
        loses=3, control=True,
    ),
)  # fmt: skip
