"""Pose refinement: a small turn and move of each photo's camera, and a factor on the focal length, learned with the field."""

import copy
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Projection, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.refine.gauge import (
    gauge_directions,
    orthonormal_basis,
    pixel_shifts,
    precondition,
    project_out,
    rotate,
)
from nerf_lightning.utils.seeding import Stream, step_generator

NUM_POINTS = 512
"""Points in the box by which the motion of a camera is measured."""
DAMPING = 1.0
"""See `precondition`. A turn and a move of a camera that undo each other in the photo are told apart slowly, and surely."""


class PoseRefinement(torch.nn.Module):
    """Motions of V cameras, preconditioned to pixels (Park et al. 2023, "CamP"); at the start there are none.

    Args:
        cameras: as given.
        bounds: of the content.
        focal: whether the focal length that all photos share is refined too.
        fixed_gauge: whether what all cameras have in common stays as it is, so that the scene does not drift away.

    Raises:
        InputError: for a focal length of lenses that have none.
    """

    preconditioner: Tensor
    gauge: Tensor
    axes: Tensor

    def __init__(self, cameras: Cameras, bounds: Bounds, focal: bool = False, fixed_gauge: bool = True):
        super().__init__()
        if focal and cameras.lenses is not None and bool((cameras.lenses.projection != Projection.PERSPECTIVE).any()):
            found = "true, with fisheye lenses or photos of all directions"
            raise InputError("refine.focal", "", found, "false for these")
        centres, middle = cameras.centres.cpu().double(), bounds.centre.cpu().double()
        corners = torch.rand(NUM_POINTS, 3, dtype=torch.float64, generator=step_generator(0, Stream.STUDY, 0))
        points = middle + bounds.half_size.cpu().double() * (2 * corners - 1)
        scales = precondition(pixel_shifts(centres, cameras.K[:, 0, 0].cpu().double(), points), DAMPING)
        gauge = torch.linalg.solve(scales, gauge_directions(centres, middle))
        self.register_buffer("preconditioner", scales.float())
        self.register_buffer("gauge", orthonormal_basis(gauge.flatten(0, 1)).float(), persistent=False)
        self.register_buffer("axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        self.motions = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=False)
        self.fixed_gauge = fixed_gauge
        self.focal_step = float(2 / (cameras.sizes.to(cameras.K) / 2).norm(dim=1).median())
        """So that `log_focal` is in pixels halfway to the corners."""
        self.log_focal = torch.nn.Parameter(torch.zeros(()), requires_grad=False) if focal else None

    @property
    def is_active(self) -> bool:
        """Whether cameras move."""
        return self.motions.requires_grad

    @property
    def focal_factor(self) -> Float[Tensor, ""] | None:
        """On the focal length, if that is refined."""
        return None if self.log_focal is None else (self.focal_step * self.log_focal).exp()

    def share_lens(self, other: "PoseRefinement") -> None:
        """Takes the focal length of another refinement, not learned any further."""
        self.log_focal = copy.deepcopy(other.log_focal)
        if self.log_focal is not None:
            self.log_focal.requires_grad_(False)

    def turns_and_moves(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Of each camera: about its centre (world axes, radians), and of it (world units)."""
        own = project_out(self.motions, self.gauge) if self.fixed_gauge else self.motions
        motions = (self.preconditioner * own[:, None]).sum(2)  # no matrix product, which half precision would round
        turns, moves = motions.split(3, dim=1)
        return turns, moves

    def forward(self, rays: Rays, views: Int[Tensor, "R"]) -> Rays:
        """Rays of these photos, as their refined cameras see."""
        if not self.is_active:
            return rays
        directions = rays.directions
        if (factor := self.focal_factor) is not None:
            axes = self.axes.index_select(0, views)
            ahead = (directions * axes).sum(1, keepdim=True) * axes
            directions = torch.nn.functional.normalize(ahead + (directions - ahead) / factor, dim=1)
        turns, moves = (x.index_select(0, views) for x in self.turns_and_moves())
        return Rays(rays.origins + moves, rotate(directions, turns))

    @torch.no_grad()
    def refine_cameras(self, given: Cameras) -> Cameras:
        """The cameras as refined."""
        turns, moves = (x.to(given.c2w) for x in self.turns_and_moves())
        c2w = given.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = rotate(c2w[:, :3, column], turns)
        c2w[:, :3, 3] += moves
        factor = self.focal_factor
        return replace(given if factor is None else given.zoomed(float(factor)), c2w=c2w)
