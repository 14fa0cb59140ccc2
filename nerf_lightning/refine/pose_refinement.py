"""Pose refinement: a small turn and move of each photo's camera, and a factor on the focal length, learned with the field."""

import copy
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Projection, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.refine.gauge import (
    compute_gauge_modes,
    compute_preconditioner,
    compute_projection_jacobian,
    orthonormal_basis,
    project_out,
    rotate_axis_angle,
)
from nerf_lightning.utils.seeding import Stream, step_generator

NUM_POINTS = 512
"""Points in the box by which the motion of a camera is measured."""
PRECONDITIONER_DAMPING = 1.0
"""See `compute_preconditioner`. A turn and a move of a camera that undo each other in the photo converge slowly."""


class PoseRefinement(torch.nn.Module):
    """Motions of V cameras, preconditioned to pixels (Park et al. 2023, "CamP"); at the start there are none.

    Args:
        cameras: as given.
        bounds: of the content.
        focal: whether the focal length that all photos share is refined too.
        fix_gauge: whether what all cameras have in common stays as it is, so that the scene does not drift away.

    Raises:
        InputError: for a focal length of lenses that have none.
    """

    preconditioner: Tensor
    gauge: Tensor
    optical_axes: Tensor

    def __init__(self, cameras: Cameras, bounds: Bounds, focal: bool = False, fix_gauge: bool = True):
        super().__init__()
        if focal and cameras.lenses is not None and bool((cameras.lenses.projection != Projection.PERSPECTIVE).any()):
            found = "true, with fisheye lenses or photos of all directions"
            raise InputError("refine.focal", "", found, "false for these")
        centres, content_centre = cameras.centres.cpu().double(), bounds.centre.cpu().double()
        corners = torch.rand(NUM_POINTS, 3, dtype=torch.float64, generator=step_generator(0, Stream.ANALYSIS, 0))
        points = content_centre + bounds.half_size.cpu().double() * (2 * corners - 1)
        preconditioner = compute_preconditioner(
            compute_projection_jacobian(centres, cameras.K[:, 0, 0].cpu().double(), points), PRECONDITIONER_DAMPING
        )
        gauge = torch.linalg.solve(preconditioner, compute_gauge_modes(centres, content_centre))
        self.register_buffer("preconditioner", preconditioner.float())
        self.register_buffer("gauge", orthonormal_basis(gauge.flatten(0, 1)).float(), persistent=False)
        self.register_buffer("optical_axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        self.pose_adjustment = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=False)
        self.fix_gauge = fix_gauge
        self.focal_preconditioner = float(2 / (cameras.sizes.to(cameras.K) / 2).norm(dim=1).median())
        """So that `log_focal` is in pixels halfway to the corners."""
        self.log_focal = torch.nn.Parameter(torch.zeros(()), requires_grad=False) if focal else None

    @property
    def is_active(self) -> bool:
        """Whether cameras move."""
        return self.pose_adjustment.requires_grad

    @property
    def focal_factor(self) -> Float[Tensor, ""] | None:
        """On the focal length, if that is refined."""
        return None if self.log_focal is None else (self.focal_preconditioner * self.log_focal).exp()

    def copy_lens(self, other: "PoseRefinement") -> None:
        """Takes the focal length of another refinement, not learned any further."""
        self.log_focal = copy.deepcopy(other.log_focal)
        if self.log_focal is not None:
            self.log_focal.requires_grad_(False)

    def compute_pose_deltas(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Of each camera: about its centre (world axes, radians), and of it (world units)."""
        adjustment = project_out(self.pose_adjustment, self.gauge) if self.fix_gauge else self.pose_adjustment
        deltas = (self.preconditioner * adjustment[:, None]).sum(
            2
        )  # no matrix product, which half precision would round
        rotations, translations = deltas.split(3, dim=1)
        return rotations, translations

    def forward(self, rays: Rays, views: Int[Tensor, "R"]) -> Rays:
        """Rays of these photos, as their refined cameras see."""
        if not self.is_active:
            return rays
        directions = rays.directions
        if (factor := self.focal_factor) is not None:
            axes = self.optical_axes.index_select(0, views)
            axial = (directions * axes).sum(1, keepdim=True) * axes
            directions = torch.nn.functional.normalize(axial + (directions - axial) / factor, dim=1)
        rotations, translations = (x.index_select(0, views) for x in self.compute_pose_deltas())
        return Rays(rays.origins + translations, rotate_axis_angle(directions, rotations))

    @torch.no_grad()
    def refine_cameras(self, cameras: Cameras) -> Cameras:
        """The cameras as refined."""
        rotations, translations = (x.to(cameras.c2w) for x in self.compute_pose_deltas())
        c2w = cameras.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = rotate_axis_angle(c2w[:, :3, column], rotations)
        c2w[:, :3, 3] += translations
        factor = self.focal_factor
        return replace(cameras if factor is None else cameras.zoom(float(factor)), c2w=c2w)
