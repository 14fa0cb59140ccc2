"""What is learned about each photo's camera and light."""

from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.refine.poses import pixel_shifts, turned, whitening
from nerf_lightning.utils.listing import first_few
from nerf_lightning.utils.seeding import Stream, step_generator

PLACES = 512
"""Places in the box by which the motion of a camera is measured."""
DAMPING = 1.0
"""See `whitening`. A turn and a move of a camera that undo each other in the photo are told apart slowly, and surely."""
START = 0.02
"""Share of the training before which nothing is corrected: photos cannot fit a field that shows nothing yet."""
TRIALS = (0.02, 0.04, 0.07, 0.1, 0.2, 0.4)
"""Shares of it at which `auto` tries what it does not correct yet: large faults show while the field is smooth, as later it has
explained them by fog; small ones show when it is sharp."""
LIT = 0.04
"""Share of it before which gains are not tried: a field that is still too dark everywhere wants gains."""
HURRY, FAR, FASTER = 0.1, 4.0, 3.0
"""Poses move `FASTER` times as fast for a first share of the training, and then where they have moved far: with the root mean
square of how far the content has moved in the photos, above `FAR` pixels. What is far off would else not arrive."""
WORTHWHILE = {"poses": 0.01, "light": 0.05}
"""Share by which most photos' squared error has to fall. Exact poses raise it; gains explain a little of all that is wrong, and
make the neutral look another than that of the photos."""
FAR_OFF = 2.5
"""Degrees by which most cameras may have turned: from 2 degrees they come back, from 5 most do not."""
APART, NAMED = 4.0, 5
"""Times the median by which a photo moves far more than the others, and how many of such are named."""
RIPENED = 0.4
"""Share of the training that it takes, once poses are corrected, until the field has grown."""
PARAMETERS = {"poses": "motions", "light": "log_gains"}


class Corrections(torch.nn.Module):
    """A correction of each photo's camera, and gains of its colours; at the start there are none.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        poses: whether cameras turn and move.
        light: whether photos have gains.
        pose_rate: learning rate of poses, in pixels that the content moves a step.
        light_rate: learning rate of the gains' logarithms.
        auto: whether each is corrected from the first trial on that shows that it helps, and else not; see `due` and `note`.
        centred: whether the means over the photos stay zero, so that a scene neither drifts away nor grows brighter; photos
            of a field that is already there have their own.

    Raises:
        InputError: where neither is to be corrected, or a rate is not above 0.
    """

    FINAL = 0.1
    """Factor on the rates at the end."""
    scales: Tensor

    def __init__(
        self,
        cameras: Cameras,
        bounds: Bounds,
        poses: bool = True,
        light: bool = True,
        pose_rate: float = 0.1,
        light_rate: float = 0.003,
        auto: bool = False,
        centred: bool = True,
    ):
        super().__init__()
        if not (poses or light):
            raise InputError("refine.poses", "", "false, with refine.light=false", "one of them", "or give refine=null")
        self.given_rates = pose_rate, light_rate
        for name, rate in (("pose_rate", pose_rate), ("light_rate", light_rate)):
            if not rate > 0:
                raise InputError(f"refine.{name}", "", str(rate), "above 0")
        rates = ("poses", pose_rate, poses), ("light", light_rate, light)
        corners = torch.rand(PLACES, 3, dtype=torch.float64, generator=step_generator(0, Stream.STUDY, 0))
        places = bounds.centre.cpu().double() + bounds.half_size.cpu().double() * (2 * corners - 1)
        shifts = pixel_shifts(cameras.centres.cpu().double(), cameras.K[:, 0, 0].cpu().double(), places)
        self.register_buffer("scales", whitening(shifts, DAMPING).float())
        self.motions = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=False)
        self.log_gains = torch.nn.Parameter(torch.zeros(len(cameras), 3), requires_grad=False)
        self.centred = centred
        self.rates = {name: rate for name, rate, wanted in rates if wanted}
        self.auto = auto
        self.tried = 0
        """Trials so far."""
        self.worth: dict[str, float] = {}
        """What the last of them said, see `note`."""
        self.since: dict[str, float] = {}
        """What is corrected, and from which progress on."""
        if not auto:
            self.begin(START, *self.rates)

    def begin(self, progress: float, *names: str) -> None:
        """Corrects poses or light from now on."""
        for name in names:
            self.since[name] = progress
            self.get_parameter(PARAMETERS[name]).requires_grad_(True)

    def due(self, progress: float) -> bool:
        """Whether it is time for a trial."""
        undecided = self.auto and len(self.since) < len(self.rates)
        return undecided and self.tried < len(TRIALS) and progress >= TRIALS[self.tried]

    def note(self, progress: float, worth: dict[str, float]) -> None:
        """Takes in what a trial said: by what share the squared error would fall if poses, or light, were corrected."""
        self.tried = sum(progress >= share for share in TRIALS)
        open_yet = [name for name in self.rates if name not in self.since and (name != "light" or progress >= LIT)]
        self.worth |= {name: worth[name] for name in open_yet}
        self.begin(progress, *(name for name in open_yet if worth[name] > WORTHWHILE[name]))

    def decided(self) -> dict[str, Any]:
        """What the state of the parameters does not say, for `decide`."""
        return {"tried": self.tried, "worth": self.worth, "since": self.since}

    def decide(self, decided: dict[str, Any]) -> None:
        """Goes on as decided before."""
        self.tried, self.worth = int(decided["tried"]), dict(decided["worth"])
        for name, progress in decided["since"].items():
            self.begin(progress, name)

    @property
    def groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups: what is or may be corrected, each with its learning rate."""
        return [{"params": [self.get_parameter(PARAMETERS[name])], "lr": rate} for name, rate in self.rates.items()]

    def alike(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """With what is corrected here, for photos of the field that was trained with these."""
        poses, light = ("poses" in self.since), ("light" in self.since)
        return Corrections(cameras, bounds, poses, light, *self.given_rates, centred=False)

    def factors(self, progress: float) -> list[float]:
        """On the rates of `groups`, by progress in training: nothing at first, then from 1 down to `FINAL`."""
        return [self._factor(name, self.since.get(name), progress) for name in self.rates]

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

    def ripeness(self, progress: float, grown_after: float) -> float:
        """The progress by which a field grows: slower while cameras find their places, as detail would hold them where they
        are."""
        start = self.since.get("poses", 1.0)
        if not start < grown_after or progress < start:
            return progress
        return min(progress, start + (grown_after - start) * (progress - start) / RIPENED)

    def _own(self, values: Float[Tensor, "V K"]) -> Float[Tensor, "V K"]:
        """Without their mean, if that is to be zero."""
        return values - values.mean(0) if self.centred else values

    @property
    def turns_and_moves(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Of each camera: about its centre (world axes, radians), and of it (world units)."""
        motions = (self.scales * self.motions[:, None]).sum(2)  # no matrix product, which half precision would round
        turns, moves = self._own(motions).split(3, dim=1)
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
        return Rays(rays.origins + moves, turned(rays.directions, turns))

    def lit(
        self,
        rgb: Float[Tensor, "R 3"],
        opacity: Float[Tensor, "R"],
        backgrounds: Float[Tensor, "R 3"],
        views: Int[Tensor, "R"],
        truth: Float[Tensor, "R 3"] | None = None,
    ) -> Float[Tensor, "R 3"]:
        """Rendered colours as these photos show them; what is behind stays as it is.

        Where a photo's own colours are given and are burnt out (1), those that are brighter still count as equal.
        """
        if not self.log_gains.requires_grad:
            return rgb
        behind = (1 - opacity)[:, None] * backgrounds
        found = (rgb - behind) * self.gains.index_select(0, views) + behind
        return found if truth is None else torch.where(truth >= 1, found.clamp_max(1), found)

    @torch.no_grad()
    def cameras(self, given: Cameras) -> Cameras:
        """The cameras as corrected."""
        turns, moves = (x.to(given.c2w) for x in self.turns_and_moves)
        c2w = given.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = turned(c2w[:, :3, column], turns)
        c2w[:, :3, 3] += moves
        return replace(given, c2w=c2w)

    def told(self, name: Callable[[int], str] = "photo {}".format) -> str:
        """In a line, what was found; `name` gives the names of photos."""
        found, said = self.summary(), []
        if "poses" in self.since:
            turned_by, moved_by = max(found["turned_degrees"]), max(found["moved"])
            said.append(f"cameras turned by up to {turned_by:.2f} degrees and moved by up to {moved_by:.3g}")
            if apart := self.moved_apart():
                said.append(f"far more than the others: {first_few([name(i) for i in apart], NAMED)}")
            if (middle := median(found["turned_degrees"])) > FAR_OFF:
                said.append(
                    f"half of them by more than {middle:.1f} degrees, too far for all to have found their places"
                )
        if "light" in self.since:
            said.append(f"exposure from {min(found['exposure']):.2f} to {max(found['exposure']):.2f}")
        for part in self.rates:
            if part not in self.since:
                share = max(0.0, self.worth.get(part, 0.0))
                said.append(f"{part} as given (corrections would lower most photos' error by {share:.1%})")
        return "refine: " + "; ".join(said)

    def moved_apart(self) -> list[int]:
        """Photos whose content moved far, and many times as far as in the others; the farthest first."""
        moved = self.motions.detach().norm(dim=1)
        limit = max(FAR, APART * float(moved.median()))
        return [int(i) for i in moved.argsort(descending=True) if moved[i] > limit]

    @torch.no_grad()
    def summary(self) -> dict[str, list[float]]:
        """Of each photo: the angle it turned by in degrees, how far it moved in world units, and its mean gain."""
        turns, moves = self.turns_and_moves
        columns = turns.norm(dim=1).rad2deg(), moves.norm(dim=1), self.gains.log().mean(1).exp()
        names = ("turned_degrees", "moved", "exposure")
        return {name: [round(x, 5) for x in column.tolist()] for name, column in zip(names, columns, strict=True)}
