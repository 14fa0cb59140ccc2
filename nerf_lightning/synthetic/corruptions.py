"""Corruptions of a scene, deterministic in the seed. Held-out views stay correct unless stated otherwise."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import subsample

PoseTransform = Callable[[Float[Tensor, "V 4 4"]], Float[Tensor, "V 4 4"]]
ColorTransform = Callable[[Float[Tensor, "V H W 3"]], Float[Tensor, "V H W 3"]]


def map_poses(views: Views, change: PoseTransform) -> Views:
    """Applies a function to the camera-to-world matrices."""
    return replace(views, cameras=replace(views.cameras, c2w=change(views.cameras.c2w.clone())))


def map_colors(views: Views, change: ColorTransform) -> Views:
    """Applies a function to the colors, in [0, 1]; alpha stays."""
    photos = views.images.float() / 255
    photos = torch.cat([change(photos[..., :3]), photos[..., 3:]], dim=-1)
    return Views.from_images((photos.clamp(0, 1) * 255).round().to(torch.uint8), views.cameras)


def flip_axes(scene: Scene, seed: int) -> Scene:
    """Flips all poses as if OpenGL poses (y up, z backward) were read as OpenCV ones."""
    axes = torch.tensor([1.0, -1.0, -1.0, 1.0])
    train, val = (map_poses(views, lambda c2w: c2w * axes) for views in (scene.train, scene.val))
    return replace(scene, train=train, val=val)


def shuffle_poses(scene: Scene, seed: int) -> Scene:
    """Permutes the poses of the training photos."""
    order = torch.randperm(len(scene.train), generator=step_generator(seed, Stream.ANALYSIS, 0))
    return replace(scene, train=map_poses(scene.train, lambda c2w: c2w[order]))


def swap_poses(scene: Scene, seed: int, count: int) -> Scene:
    """Rotates the poses among `count` evenly spaced training photos."""
    wrong, order = subsample(len(scene.train), count), torch.arange(len(scene.train))
    order[wrong] = torch.tensor([*wrong[1:], wrong[0]])
    return replace(scene, train=map_poses(scene.train, lambda c2w: c2w[order]))


def add_pose_noise(scene: Scene, seed: int, degrees: float, shift_std: float = 0.0) -> Scene:
    """Rotates training cameras about random axes, and moves them.

    Args:
        degrees: standard deviation of the angles.
        shift_std: standard deviation of the shifts, relative to the cameras' mean distance to the content's center.
    """

    def perturb(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 4"]:
        generator = step_generator(seed, Stream.ANALYSIS, 1)
        vectors = torch.randn(len(c2w), 3, generator=generator) * (degrees / 180 * torch.pi / 3**0.5)
        cross = torch.zeros(len(c2w), 3, 3)
        cross[:, [2, 0, 1], [1, 2, 0]] = vectors
        c2w[:, :3, :3] = torch.linalg.matrix_exp(cross - cross.mT) @ c2w[:, :3, :3]
        distance = float((c2w[:, :3, 3] - scene.bounds.center).norm(dim=1).mean())
        c2w[:, :3, 3] += torch.randn(len(c2w), 3, generator=generator) * (shift_std * distance / 3**0.5)
        return c2w

    return replace(scene, train=map_poses(scene.train, perturb))


def vary_exposure(scene: Scene, seed: int, max_change: float, tint: float = 0.0) -> Scene:
    """Scales the exposure of training photos by up to `max_change`, and of each channel by up to `tint`."""
    generator, count = step_generator(seed, Stream.ANALYSIS, 2), len(scene.train)
    gains = 1 + max_change * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    gains = gains * (1 + tint * (2 * torch.rand(count, 1, 1, 3, generator=generator) - 1))
    return replace(scene, train=map_colors(scene.train, lambda rgb: rgb * gains))


def add_image_noise(scene: Scene, seed: int, std: float) -> Scene:
    """Adds Gaussian noise to each training pixel."""
    noise = std * torch.randn(scene.train.images[..., :3].shape, generator=step_generator(seed, Stream.ANALYSIS, 3))
    return replace(scene, train=map_colors(scene.train, lambda rgb: rgb + noise))


def add_vignetting(scene: Scene, seed: int, falloff: float) -> Scene:
    """Darkens all photos, held-out ones too, by `falloff` in the corners, with the squared distance to the center."""

    def darken(rgb: Float[Tensor, "V H W 3"]) -> Float[Tensor, "V H W 3"]:
        row, column = ((torch.arange(size) + 0.5) / size * 2 - 1 for size in rgb.shape[1:3])
        return rgb * (1 - falloff * (row[:, None].square() + column.square())[..., None] / 2)

    return replace(scene, train=map_colors(scene.train, darken), val=map_colors(scene.val, darken))


def scale_focal_length(scene: Scene, seed: int, factor: float) -> Scene:
    """Multiplies the focal length of all cameras, held-out ones too."""
    train, val = (replace(views, cameras=views.cameras.zoom(factor)) for views in (scene.train, scene.val))
    return replace(scene, train=train, val=val)


def subsample_views(scene: Scene, seed: int, count: int) -> Scene:
    """Keeps `count` evenly spaced training photos."""
    return replace(scene, train=scene.train.subsample(count))


def scale_world(scene: Scene, seed: int, factor: float) -> Scene:
    """Scales the world unit of cameras, orbit and bounds."""
    factors = torch.tensor([1.0, 1.0, 1.0, factor]).expand(4, 4).clone()
    factors[3, 3] = 1.0
    train, val = (map_poses(views, lambda c2w: c2w * factors) for views in (scene.train, scene.val))
    orbit = replace(scene.orbit, c2w=scene.orbit.c2w * factors)
    return replace(scene, train=train, val=val, orbit=orbit, bounds=Bounds(scene.bounds.aabb * factor))


def scale_near_far(scene: Scene, seed: int, factor: float) -> Scene:
    """Sets near and far planes that are wrong by a factor."""
    distance = float(scene.train.cameras.centers.norm(dim=1).mean())
    radius = float(scene.bounds.half_size.norm())
    near, far = factor * (distance - radius), factor * (distance + radius)
    return replace(scene, bounds=replace(scene.bounds, near=near, far=far))


def scale_bounds(scene: Scene, seed: int, factor: float) -> Scene:
    """Scales the bounds but not the content."""
    return replace(scene, bounds=Bounds(scene.bounds.aabb * factor))


def set_wrong_background(scene: Scene, seed: int) -> Scene:
    """Declares a white background for the same photos."""
    return replace(scene, background=(1.0, 1.0, 1.0))
