"""What is learned about each photo's camera and light."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.refine.poses import pixel_shifts, turned, whitening
from nerf_lightning.utils.seeding import Stream, step_generator

PLACES = 512
"""Places in the box by which the motion of a camera is measured."""
DAMPING = 1.0
"""See `whitening`. A turn and a move of a camera that undo each other in the photo are told apart slowly, and surely."""
START = 0.05
"""Share of the training before which nothing is corrected: photos cannot fit a field that shows nothing yet."""


class Corrections(torch.nn.Module):
    """A correction of each photo's camera, and gains of its colours; at the start there are none.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        poses: whether cameras turn and move.
        light: whether photos have gains.
        pose_rate: learning rate of poses, in pixels that the content moves a step.
        light_rate: learning rate of the gains' logarithms.
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
        centred: bool = True,
    ):
        super().__init__()
        if not (poses or light):
            raise InputError("refine.poses", "", "false, with refine.light=false", "one of them", "or give refine=null")
        for name, rate in (("pose_rate", pose_rate), ("light_rate", light_rate)):
            if not rate > 0:
                raise InputError(f"refine.{name}", "", str(rate), "above 0")
        corners = torch.rand(PLACES, 3, dtype=torch.float64, generator=step_generator(0, Stream.STUDY, 0))
        places = bounds.centre.cpu().double() + bounds.half_size.cpu().double() * (2 * corners - 1)
        shifts = pixel_shifts(cameras.centres.cpu().double(), cameras.K[:, 0, 0].cpu().double(), places)
        self.register_buffer("scales", whitening(shifts, DAMPING).float())
        self.motions = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=poses)
        self.log_gains = torch.nn.Parameter(torch.zeros(len(cameras), 3), requires_grad=light)
        self.centred = centred
        self.rates = {"motions": pose_rate, "log_gains": light_rate}

    @property
    def groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups: what is corrected, each with its learning rate."""
        free = [(name, parameter) for name, parameter in self.named_parameters() if parameter.requires_grad]
        return [{"params": [parameter], "lr": self.rates[name]} for name, parameter in free]

    def alike(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """Of the same kind, for photos of the field that was trained with these."""
        poses, light = self.motions.requires_grad, self.log_gains.requires_grad
        pose_rate, light_rate = self.rates.values()
        return Corrections(cameras, bounds, poses, light, pose_rate, light_rate, centred=False)

    def schedule(self, progress: float) -> float:
        """Factor on the rates by progress in training: nothing at first, then from 1 down to `FINAL`."""
        return 0.0 if progress < START else self.FINAL ** ((progress - START) / (1 - START))

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
    ) -> Float[Tensor, "R 3"]:
        """Rendered colours as these photos show them; what is behind stays as it is."""
        if not self.log_gains.requires_grad:
            return rgb
        behind = (1 - opacity)[:, None] * backgrounds
        return (rgb - behind) * self.gains.index_select(0, views) + behind

    @torch.no_grad()
    def cameras(self, given: Cameras) -> Cameras:
        """The cameras as corrected."""
        turns, moves = (x.to(given.c2w) for x in self.turns_and_moves)
        c2w = given.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = turned(c2w[:, :3, column], turns)
        c2w[:, :3, 3] += moves
        return replace(given, c2w=c2w)

    def told(self) -> str:
        """In a line, what was found."""
        found, said = self.summary(), []
        if self.motions.requires_grad:
            turned_by, moved_by = max(found["turned_degrees"]), max(found["moved"])
            said.append(f"cameras turned by up to {turned_by:.2f} degrees and moved by up to {moved_by:.3g}")
        if self.log_gains.requires_grad:
            said.append(f"exposure from {min(found['exposure']):.2f} to {max(found['exposure']):.2f}")
        return "refine: " + "; ".join(said)

    @torch.no_grad()
    def summary(self) -> dict[str, list[float]]:
        """Of each photo: the angle it turned by in degrees, how far it moved in world units, and its mean gain."""
        turns, moves = self.turns_and_moves
        columns = turns.norm(dim=1).rad2deg(), moves.norm(dim=1), self.gains.log().mean(1).exp()
        names = ("turned_degrees", "moved", "exposure")
        return {name: [round(x, 5) for x in column.tolist()] for name, column in zip(names, columns, strict=True)}
