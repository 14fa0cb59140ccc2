"""What is learned about each photo's camera and light."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.refine.lens import LensCorrections
from nerf_lightning.refine.poses import drifts, pixel_shifts, spanned, turned, whitening, without
from nerf_lightning.utils.seeding import Stream, step_generator

GAMMA = 2.2
"""Of sRGB, about: pixels grow with the light to the power of 1 / GAMMA."""
PLACES = 512
"""Places in the box by which the motion of a camera is measured."""
DAMPING = 1.0
"""See `whitening`. A turn and a move of a camera that undo each other in the photo are told apart slowly, and surely."""
START = 0.02
"""Share of the training before which nothing is corrected: photos cannot fit a field that shows nothing yet."""
FIRST, GROWTH, LAST = 24, 2, 0.4
"""Of the trials of `auto`: the step of the first, the factor from one to the next, and the share of the training that they end
with. Large faults show while the field is smooth, as later it has explained them by fog; small ones when it is sharp."""
EARLY, TWICE = 64, 2
"""Steps before which gains are not tried, as a field that is still too dark everywhere wants gains; and how many times as much
poses have to explain before: a field that is still blurred follows any motion a little."""
HURRY, FAR, FASTER = 0.1, 4.0, 3.0
"""Poses move `FASTER` times as fast for a first share of the training, and then where they have moved far: with the root mean
square of how far the content has moved in the photos, above `FAR` pixels. What is far off would else not arrive."""
WORTHWHILE = {"poses": 0.01, "light": 0.05}
"""Share by which most photos' squared error has to fall. Exact poses raise it; gains explain a little of all that is wrong, and
make the neutral look another than that of the photos."""
GROWTH_DELAY = 0.4
"""Share of the training that it takes, once poses are corrected, until the field has grown."""


class Corrections(torch.nn.Module):
    """A correction of each photo's camera, and gains of its colours; at the start there are none.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        exposures: light that each photo gathered, in any unit, as its file states; empty where that is not known. Gains start
            from them; with `auto` only if that lowers the error.
        poses: whether cameras turn and move.
        light: whether photos have gains.
        focal: whether, with poses, the focal length that all photos share is corrected.
        affine: whether, with light, the colours of each photo are mixed and shifted too, besides their gains.
        vignetting: whether, with light, photos may be darker toward their corners, all alike.
        pose_rate: learning rate of poses, in pixels that the content moves a step.
        light_rate: learning rate of the gains' logarithms.
        auto: whether each is corrected from the first trial on that shows that it helps, and else not; see `due` and `note`.
        centred: whether what all photos have in common stays as it is, so that a scene neither drifts away nor grows brighter;
            photos of a field that is already there have their own.

    Raises:
        InputError: where neither is to be corrected, a part of what is not, or a rate is not above 0.
    """

    FINAL = 0.1
    """Factor on the rates at the end."""
    scales: Tensor
    common: Tensor
    stated: Tensor

    def __init__(
        self,
        cameras: Cameras,
        bounds: Bounds,
        exposures: Sequence[float] = (),
        poses: bool = True,
        light: bool = True,
        focal: bool = False,
        affine: bool = False,
        vignetting: bool = False,
        pose_rate: float = 0.1,
        light_rate: float = 0.003,
        auto: bool = False,
        centred: bool = True,
    ):
        super().__init__()
        if not (poses or light):
            raise InputError("refine.poses", "", "false, with refine.light=false", "one of them", "or give refine=null")
        for name, part, whole in (
            ("focal", focal, poses),
            ("affine", affine, light),
            ("vignetting", vignetting, light),
        ):
            if part and not whole:
                needed = "refine.poses" if name == "focal" else "refine.light"
                raise InputError(f"refine.{name}", "", f"true, with {needed}=false", "false", f"or give {needed}=true")
        for name, rate in (("pose_rate", pose_rate), ("light_rate", light_rate)):
            if not rate > 0:
                raise InputError(f"refine.{name}", "", str(rate), "above 0")
        rates = ("poses", pose_rate, poses), ("light", light_rate, light)
        corners = torch.rand(PLACES, 3, dtype=torch.float64, generator=step_generator(0, Stream.STUDY, 0))
        places = bounds.centre.cpu().double() + bounds.half_size.cpu().double() * (2 * corners - 1)
        shifts = pixel_shifts(cameras.centres.cpu().double(), cameras.K[:, 0, 0].cpu().double(), places)
        scales = whitening(shifts, DAMPING)
        common = torch.linalg.solve(scales, drifts(cameras.centres.cpu().double(), bounds.centre.cpu().double()))
        self.register_buffer("scales", scales.float())
        self.register_buffer("common", spanned(common.flatten(0, 1)).float(), persistent=False)
        self.motions = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=False)
        self.log_gains = torch.nn.Parameter(torch.zeros(len(cameras), 3), requires_grad=False)
        logs = torch.tensor(exposures).log() / GAMMA if exposures else torch.zeros(len(cameras))
        self.register_buffer("stated", (logs - logs.mean())[:, None].expand(-1, 3).clone(), persistent=False)
        self.mixing = torch.nn.Parameter(torch.zeros(len(cameras), 3, 4), requires_grad=False) if affine else None
        self.lens = LensCorrections(cameras, focal, vignetting)
        self.centred = centred
        self.rates = {name: rate for name, rate, wanted in rates if wanted}
        self.auto = auto
        self.tried = 0
        """Trials so far, or that were missed."""
        self.worth: dict[str, float] = {}
        """What the last of them said, see `note`."""
        self.since: dict[str, float] = {}
        """What is corrected, and from which progress on."""
        if not auto:
            self.begin(START, *self.rates)
            self.log_gains.data.copy_(self.stated * light)

    def begin(self, progress: float, *names: str) -> None:
        """Corrects poses or light from now on."""
        for name in names:
            self.since[name] = progress
            for parameter in self._of(name):
                parameter.requires_grad_(True)

    def begin_poses(self) -> None:
        """Corrects poses, if they may be, from the first step on, as they are certainly wrong: they have far to go, and a field
        that explains them by fog would let no trial tell."""
        if "poses" in self.rates and "poses" not in self.since:
            self.begin(0.0, "poses")

    def _of(self, name: str) -> list[torch.nn.Parameter]:
        """What is learned of poses, or of light."""
        poses, light = (self.motions, self.lens.zoom), (self.log_gains, self.mixing, self.lens.darkening)
        return [one for one in (poses if name == "poses" else light) if one is not None]

    def due(self, step: int, progress: float) -> bool:
        """Whether it is time for a trial."""
        in_time = progress <= LAST and step >= FIRST * GROWTH**self.tried
        return self.auto and in_time and bool(self.open_at(step))

    def open_at(self, step: int) -> list[str]:
        """What a trial at this step decides on."""
        return [name for name in self.rates if name not in self.since and (name != "light" or step >= EARLY)]

    def helps(self, step: int, worth: dict[str, float], share: float = 1.0) -> list[str]:
        """What would, by trials at this step that said this; or might, as it explains this share of what it has to."""
        times = share * (TWICE if step < EARLY else 1)
        return [name for name in self.open_at(step) if worth[name] > times * WORTHWHILE[name]]

    def note(self, step: int, progress: float, worth: dict[str, float]) -> None:
        """Takes in what a trial said: by what share the squared error would fall if poses, or light, were corrected, or the
        stated exposures were taken for gains."""
        while step >= FIRST * GROWTH**self.tried:
            self.tried += 1
        chosen = self.helps(step, worth)
        self.worth |= {name: worth[name] for name in self.open_at(step)}
        self.begin(progress, *chosen)
        if "light" in chosen and worth["stated"] > 0:
            self.log_gains.data.copy_(self.stated)

    def decided(self) -> dict[str, Any]:
        """What the state of the parameters does not say, for `decide`."""
        return {"tried": self.tried, "worth": self.worth, "since": self.since}

    def decide(self, decided: dict[str, Any]) -> None:
        """Goes on as decided before."""
        self.tried, self.worth = decided["tried"], dict(decided["worth"])
        for name, progress in decided["since"].items():
            self.begin(progress, name)

    @property
    def finite(self) -> bool:
        """Whether all of it are finite numbers: some are not any more where training has broken down."""
        return all(bool(tensor.isfinite().all()) for tensor in self.state_dict().values())

    def param_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups: what is or may be corrected, each with its learning rate."""
        return [{"name": name, "params": self._of(name), "lr": rate} for name, rate in self.rates.items()]

    def alike(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """With what is corrected here, for photos of the field that was trained with these: by the same lens, and with gains
        alone."""
        poses, light = ("poses" in self.since), ("light" in self.since)
        other = Corrections(cameras, bounds, poses=poses, light=light, centred=False)
        other.lens = self.lens.of(cameras)
        return other

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Factors on the rates of these groups, by progress in training: nothing at first, then from 1 down to `FINAL`."""
        return {name: self._factor(name, self.since.get(name), progress) for name in self.rates}

    def _factor(self, name: str, start: float | None, progress: float) -> float:
        if start is None or progress < start:
            return 0.0
        pace = self.pace(progress - start) if name == "poses" else 1.0
        return pace * self.FINAL ** ((progress - start) / (1 - start))

    def pace(self, passed: float) -> float:
        """Factor on the rate of poses, by how far they have moved since a share of the training ago."""
        if passed < HURRY:
            return FASTER
        moved = float(self.motions.detach().square().sum(1).mean().sqrt())  # in pixels, as they are whitened
        return min(FASTER, max(1.0, moved / FAR))

    def delay_growth(self, progress: float, growth_end: float) -> float:
        """The progress by which a field grows: slower while cameras find their places, as detail would hold them where they
        are."""
        start = self.since.get("poses", 1.0)
        if not start < growth_end or progress < start:
            return progress
        return min(progress, start + (growth_end - start) * (progress - start) / GROWTH_DELAY)

    def _own(self, values: Float[Tensor, "V *K"]) -> Float[Tensor, "V *K"]:
        """Without their mean, if that is to be zero."""
        return values - values.mean(0) if self.centred else values

    @property
    def turns_and_moves(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Of each camera: about its centre (world axes, radians), and of it (world units)."""
        own = without(self.motions, self.common) if self.centred else self.motions
        motions = (self.scales * own[:, None]).sum(2)  # no matrix product, which half precision would round
        turns, moves = motions.split(3, dim=1)
        return turns, moves

    @property
    def gains(self) -> Float[Tensor, "V 3"]:
        """Factors on each photo's red, green and blue."""
        return self._own(self.log_gains).exp()

    def rays(self, rays: Rays, views: Int[Tensor, "R"]) -> Rays:
        """Rays of these photos, as their corrected cameras see."""
        if not self.motions.requires_grad:
            return rays
        turns, moves = (x.index_select(0, views) for x in self.turns_and_moves)
        return Rays(rays.origins + moves, turned(self.lens.zoomed(rays.directions, views), turns))

    def lit(
        self,
        rgb: Float[Tensor, "R 3"],
        opacity: Float[Tensor, "R"],
        backgrounds: Float[Tensor, "R 3"],
        given: Rays,
        views: Int[Tensor, "R"],
        truth: Float[Tensor, "R 3"] | None = None,
    ) -> Float[Tensor, "R 3"]:
        """Rendered colours as these photos show them; what is behind stays as it is.

        Where a photo's own colours are given and are burnt out (1), those that are brighter still count as equal.

        Args:
            rgb, opacity: rendered.
            backgrounds: colours behind.
            given: the pixels' rays, by the cameras as given.
            views: the photos.
            truth: their own colours.
        """
        if not self.log_gains.requires_grad:
            return rgb
        behind = (1 - opacity)[:, None] * backgrounds
        own = rgb - behind
        shown = own * self.gains.index_select(0, views)
        if self.mixing is not None:
            matrix, shift = self._own(self.mixing).index_select(0, views).split((3, 1), dim=2)
            shown = shown + (matrix * own[:, None]).sum(2) + shift[..., 0] * opacity[:, None]
        if self.lens.darkening is not None:
            shown = shown * self.lens.shade(given.directions, views)
        found = shown + behind
        return found if truth is None else torch.where(truth >= 1, found.clamp_max(1), found)

    @torch.no_grad()
    def cameras(self, given: Cameras) -> Cameras:
        """The cameras as corrected."""
        turns, moves = (x.to(given.c2w) for x in self.turns_and_moves)
        c2w = given.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = turned(c2w[:, :3, column], turns)
        c2w[:, :3, 3] += moves
        factor = self.lens.focal_factor
        return replace(given if factor is None else given.zoomed(float(factor)), c2w=c2w)
