"""Ways to spoil a scene on purpose; the result depends on the seed alone."""

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

Poses = Callable[[Float[Tensor, "V 4 4"]], Float[Tensor, "V 4 4"]]
Photos = Callable[[Float[Tensor, "V H W C"]], Float[Tensor, "V H W C"]]


def posed(views: Views, change: Poses) -> Views:
    """Views with other poses."""
    return replace(views, cameras=replace(views.cameras, c2w=change(views.cameras.c2w.clone())))


def exposed(views: Views, change: Photos) -> Views:
    """Views with other colours: `change` takes and gives the photos in [0, 1]."""
    colours = change(views.images.float() / 255)
    return Views.of((colours.clamp(0, 1) * 255).round().to(torch.uint8), views.cameras)


def turned_to_opengl(scene: Scene, seed: int) -> Scene:
    """OpenGL poses (y up, z backward) read as OpenCV ones."""

    def flip(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 4"]:
        c2w[:, :3, 1:3] *= -1
        return c2w

    return replace(scene, train=posed(scene.train, flip), val=posed(scene.val, flip))


def shuffled(scene: Scene, seed: int) -> Scene:
    """Each training photo has another one's pose."""
    order = torch.randperm(len(scene.train), generator=step_generator(seed, Stream.STUDY, 0))
    return replace(scene, train=posed(scene.train, lambda c2w: c2w[order]))


def with_pose_noise(scene: Scene, seed: int, degrees: float, moved: float = 0.0) -> Scene:
    """Training cameras turned about random axes, by angles of that standard deviation, and moved by lengths of another, given
    as a share of their mean distance to the content's centre."""

    def shake(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 4"]:
        generator = step_generator(seed, Stream.STUDY, 1)
        vectors = torch.randn(len(c2w), 3, generator=generator) * (degrees / 180 * torch.pi / 3**0.5)
        cross = torch.zeros(len(c2w), 3, 3)
        cross[:, [2, 0, 1], [1, 2, 0]] = vectors
        c2w[:, :3, :3] = torch.linalg.matrix_exp(cross - cross.mT) @ c2w[:, :3, :3]
        distance = float((c2w[:, :3, 3] - scene.bounds.centre).norm(dim=1).mean())
        c2w[:, :3, 3] += torch.randn(len(c2w), 3, generator=generator) * (moved * distance / 3**0.5)
        return c2w

    return replace(scene, train=posed(scene.train, shake))


def with_exposure_drift(scene: Scene, seed: int, share: float, tint: float = 0.0) -> Scene:
    """Training photos brighter or darker, by up to that share, and their red, green and blue by up to another each."""
    generator, count = step_generator(seed, Stream.STUDY, 2), len(scene.train)
    gains = 1 + share * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    gains = gains * (1 + tint * (2 * torch.rand(count, 1, 1, 3, generator=generator) - 1))

    def change(colours: Float[Tensor, "V H W C"]) -> Float[Tensor, "V H W C"]:
        return torch.cat([colours[..., :3] * gains, colours[..., 3:]], dim=-1)

    return replace(scene, train=exposed(scene.train, change))


def with_focal_length(scene: Scene, seed: int, factor: float) -> Scene:
    """All photos, held-out ones too, said to have that many times their focal length."""
    train, val = (replace(views, cameras=views.cameras.zoomed(factor)) for views in (scene.train, scene.val))
    return replace(scene, train=train, val=val)


def with_dark_corners(scene: Scene, seed: int, share: float) -> Scene:
    """All photos, held-out ones too, darker by that share in the corners, elsewhere by the squared distance to the centre."""

    def change(colours: Float[Tensor, "V H W C"]) -> Float[Tensor, "V H W C"]:
        row, column = ((torch.arange(size) + 0.5) / size * 2 - 1 for size in colours.shape[1:3])
        square = (row[:, None].square() + column.square()) / 2
        return torch.cat([colours[..., :3] * (1 - share * square[..., None]), colours[..., 3:]], dim=-1)

    return replace(scene, train=exposed(scene.train, change), val=exposed(scene.val, change))


def with_wrong_poses(scene: Scene, seed: int, count: int) -> Scene:
    """So many training photos, evenly spaced, with the pose of the next of them."""
    wrong = subsample(len(scene.train), count)

    def swap(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 4"]:
        c2w[wrong] = c2w[[*wrong[1:], wrong[0]]]
        return c2w

    return replace(scene, train=posed(scene.train, swap))


def with_noise(scene: Scene, seed: int, spread: float) -> Scene:
    """Noise of that standard deviation on each training pixel."""
    generator = step_generator(seed, Stream.STUDY, 3)
    return replace(scene, train=exposed(scene.train, lambda x: x + spread * torch.randn(x.shape, generator=generator)))


def with_views(scene: Scene, seed: int, count: int) -> Scene:
    """A few training photos, evenly spaced."""
    return replace(scene, train=scene.train.spread(count))


def scaled(scene: Scene, seed: int, factor: float) -> Scene:
    """The same world in another unit."""

    def scale(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 4"]:
        c2w[:, :3, 3] *= factor
        return c2w

    orbit = replace(scene.orbit, c2w=scale(scene.orbit.c2w.clone()))
    bounds = Bounds(scene.bounds.aabb * factor)
    return replace(scene, train=posed(scene.train, scale), val=posed(scene.val, scale), orbit=orbit, bounds=bounds)


def with_limits(scene: Scene, seed: int, factor: float) -> Scene:
    """near and far as a file may state them, wrong by a factor."""
    distance = float(scene.train.cameras.centres.norm(dim=1).mean())
    reach = float(scene.bounds.half_size.norm())
    near, far = factor * (distance - reach), factor * (distance + reach)
    return replace(scene, bounds=replace(scene.bounds, near=near, far=far))


def with_box(scene: Scene, seed: int, factor: float) -> Scene:
    """Bounds smaller or larger than the content."""
    return replace(scene, bounds=Bounds(scene.bounds.aabb * factor))


def with_background(scene: Scene, seed: int, colour: tuple[float, float, float]) -> Scene:
    """The same pictures, with a wrong background colour stated."""
    return replace(scene, background=colour)
