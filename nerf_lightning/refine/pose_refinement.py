"""Pose refinement: rotation and translation of each camera, and a focal length factor, learned with the field."""

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
"""Random points in the bounds by which camera motion is measured."""
PRECONDITIONER_DAMPING = 1.0
"""See `compute_preconditioner`. Rotation and translation that cancel in the photo converge slowly."""


class PoseRefinement(torch.nn.Module):
    """Motions of V cameras, preconditioned to pixels (Park et al. 2023, "CamP"), initially zero.

    Args:
        cameras: as given.
        bounds: of the content.
        focal: also refines the focal length, one factor for all photos.
        fix_gauge: projects out joint motions of all cameras, so that the scene does not drift.

    Raises:
        InputError: for `focal` with lenses that have no focal length.
    """

    preconditioner: Tensor
    gauge: Tensor
    optical_axes: Tensor

    def __init__(self, cameras: Cameras, bounds: Bounds, focal: bool = False, fix_gauge: bool = True):
        super().__init__()
        if focal and cameras.lenses is not None and bool((cameras.lenses.projection != Projection.PERSPECTIVE).any()):
            found = "true, with fisheye or equirectangular photos"
            raise InputError("refine.focal", "", found, "false for these")
        centers, content_center = cameras.centers.cpu().double(), bounds.content_center.cpu().double()
        corners = torch.rand(NUM_POINTS, 3, dtype=torch.float64, generator=step_generator(0, Stream.ANALYSIS, 0))
        points = content_center + (bounds.aabb[1] - bounds.aabb[0]).cpu().double() * (corners - 0.5)
        preconditioner = compute_preconditioner(
            compute_projection_jacobian(centers, cameras.K[:, 0, 0].cpu().double(), points), PRECONDITIONER_DAMPING
        )
        gauge = torch.linalg.solve(preconditioner, compute_gauge_modes(centers, content_center))
        self.register_buffer("preconditioner", preconditioner.float())
        self.register_buffer("gauge", orthonormal_basis(gauge.flatten(0, 1)).float(), persistent=False)
        self.register_buffer("optical_axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        self.pose_adjustment = torch.nn.Parameter(torch.zeros(len(cameras), 6), requires_grad=False)
        self.fix_gauge = fix_gauge
        self.focal_preconditioner = float(2 / (cameras.sizes.to(cameras.K) / 2).norm(dim=1).median())
        """Scales `log_focal` to pixels halfway to the corners."""
        self.log_focal = torch.nn.Parameter(torch.zeros(()), requires_grad=False) if focal else None

    @property
    def is_active(self) -> bool:
        """Whether poses are refined."""
        return self.pose_adjustment.requires_grad

    @property
    def focal_factor(self) -> Float[Tensor, ""] | None:
        """Factor on the focal length; None if it is not refined."""
        return None if self.log_focal is None else (self.focal_preconditioner * self.log_focal).exp()

    def copy_lens(self, other: "PoseRefinement") -> None:
        """Copies another refinement's focal length and freezes it."""
        self.log_focal = copy.deepcopy(other.log_focal)
        if self.log_focal is not None:
            self.log_focal.requires_grad_(False)

    def compute_pose_deltas(self) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
        """Rotation (world axes, radians) and translation (world units) of each camera."""
        adjustment = project_out(self.pose_adjustment, self.gauge) if self.fix_gauge else self.pose_adjustment
        # Not a matrix product, which autocast would round to half precision.
        rotations, translations = (self.preconditioner * adjustment[:, None]).sum(2).split(3, dim=1)
        return rotations, translations

    def forward(self, rays: Rays, views: Int[Tensor, "R"]) -> Rays:
        """Moves rays with the refined cameras of their photos."""
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
        """Applies the refinement to the cameras."""
        rotations, translations = (x.to(cameras.c2w) for x in self.compute_pose_deltas())
        c2w = cameras.c2w.clone()
        for column in range(3):
            c2w[:, :3, column] = rotate_axis_angle(c2w[:, :3, column], rotations)
        c2w[:, :3, 3] += translations
        factor = self.focal_factor
        return replace(cameras if factor is None else cameras.zoom(float(factor)), c2w=c2w)
