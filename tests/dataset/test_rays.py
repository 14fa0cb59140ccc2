from dataclasses import replace
from itertools import islice

import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, make_circle_poses
from nerf_lightning.dataset import RayDataModule, Scene, Views
from nerf_lightning.dataset.datamodule import BatchLoader
from nerf_lightning.dataset.ray_datamodule import make_batch, measure_texturelessness
from nerf_lightning.renderer import composite_over

VIEWS, HEIGHT, WIDTH = 3, 4, 6


def make_labeled_views(count: int) -> Views:
    """Each pixel's color encodes its position: (view, row, column, 255)."""
    view, row, col = torch.meshgrid(*(torch.arange(n) for n in (count, HEIGHT, WIDTH)), indexing="ij")
    images = torch.stack([view, row, col, torch.full_like(view, 255)], dim=-1).to(torch.uint8)
    c2w = make_circle_poses(torch.zeros(3), torch.tensor([0.0, 0, 1]), 4.0, 0.3, count)
    K = torch.tensor([[7.0, 0, 3.2], [0, 8, 1.7], [0, 0, 1]]) * (1 + 0.1 * torch.arange(count)[:, None, None])
    K[:, 2, 2] = 1
    return Views.from_images(images, Cameras.pinhole(K, c2w, WIDTH, HEIGHT))


@pytest.fixture
def scene() -> Scene:
    train, val = make_labeled_views(VIEWS), make_labeled_views(2)
    return Scene("labels", "test", train, val, val.cameras, Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3])))


def test_make_batch_colors_match_rays(scene: Scene):
    batch = make_batch(scene.train, scene.train.sample_pixels(50, torch.Generator().manual_seed(0)))
    assert len(batch.rays) == len(batch.pixels) == 50
    for i, (view, row, col, _) in enumerate(batch.pixels.tolist()):
        K, c2w = scene.train.cameras.K[view].double(), scene.train.cameras.c2w[view].double()
        inside = torch.linalg.inv(K) @ torch.tensor([col + 0.5, row + 0.5, 1]).double()
        direction = c2w[:3, :3] @ inside
        torch.testing.assert_close(batch.rays.origins[i].double(), c2w[:3, 3], atol=1e-6, rtol=0)
        torch.testing.assert_close(batch.rays.directions[i].double(), direction / direction.norm(), atol=1e-6, rtol=0)


def test_measure_texturelessness_step_and_slope_differ():
    """A photo with a color step and one with a ramp, of two sizes: only nearby pixels of the same photo count."""
    step, slope = torch.full((20, 160, 3), 90), torch.arange(80).expand(40, 80)[..., None].repeat(1, 1, 3)
    step[:, 100:, 1] = 120
    images = [x.to(torch.uint8) for x in (step, slope)]
    cameras = make_labeled_views(2).cameras
    views = Views(
        torch.cat([image.flatten(0, 1) for image in images]),
        replace(cameras, sizes=torch.tensor([[160, 20], [80, 40]])),
    )
    every = torch.arange(len(views.pixels))
    found = measure_texturelessness(views, every, (every >= 20 * 160).long())
    first, second = found[: 20 * 160].view(20, 160), found[20 * 160 :].view(40, 80)
    near = 2  # 1.25 % of 160 pixels
    assert (first[:, : 100 - near] == 1).all() and (first[:, 100 + near :] == 1).all()
    assert (first[:, 100 - near : 100 + near] < 1e-4).all()
    torch.testing.assert_close(second, torch.full_like(second, float(torch.tensor(-1 / 2.55).exp())))


def test_ray_data_batch_depends_only_on_seed_and_step(scene: Scene):
    def pixels(seed: int, step: int) -> list:
        return RayDataModule(scene, rays=50, seed=seed).draw(step).pixels.tolist()

    assert pixels(0, 7) == pixels(0, 7)
    assert len({str(pixels(seed, step)) for seed in (0, 1) for step in range(20)}) == 40


def test_ray_data_yields_whole_held_out_views_in_order(scene: Scene):
    data = RayDataModule(scene)
    batches = list(data.test_dataloader())
    assert len(batches) == len(data.test_dataloader()) == data.num_held_out_views == 2
    for view, batch in enumerate(batches):
        assert (batch.height, batch.width) == (HEIGHT, WIDTH)
        assert torch.equal(batch.pixels.view(HEIGHT, WIDTH, 4), scene.val.images[view])
        assert torch.equal(batch.rays.directions, scene.val.cameras.generate_view_rays(view).directions)


def test_over_alpha_blends_with_background():
    pixels = torch.tensor([[51, 51, 51, alpha] for alpha in (255, 0, 51)], dtype=torch.uint8)
    expected = torch.tensor([0.2, 0.5, 0.2 * 0.2 + 0.8 * 0.5])[:, None].expand(3, 3)
    torch.testing.assert_close(composite_over(pixels, torch.full((3, 3), 0.5)), expected)


@pytest.mark.parametrize(("first", "samples_per_ray", "scale"), [(100, 0.5, 1.0), (1000, 3.0, 1.0), (1000, 3.0, 2.0)])
def test_adapt_num_rays_converges_to_target_samples(first: int, samples_per_ray: float, scale: float, scene: Scene):
    data, most = RayDataModule(scene, rays=first, samples=6000), 0
    data.set_resolution_scale(scale)
    for _ in range(60):
        data.adapt_num_rays(round(data.rays * samples_per_ray))
        most = max(most, data.rays)
    aim = max(64, min(6000 * scale**2 / samples_per_ray, first * 32))
    assert abs(data.rays - aim) <= 0.01 * aim + 2
    assert most <= max(first, 1.02 * aim), "without overshoot"
    assert len(data.draw(0).pixels) == data.rays


def test_ray_data_state_keeps_the_number_of_rays(scene: Scene):
    data, other = (RayDataModule(scene, rays=100, samples=6000) for _ in range(2))
    data.adapt_num_rays(500)
    other.load_state_dict(data.state_dict())
    assert other.rays == data.rays != 100
    assert torch.equal(other.draw(3).pixels, data.draw(3).pixels)


def test_batch_loader_reads_step_per_batch(scene: Scene):
    steps = iter([0, 1, 5, 5])
    assert list(islice(BatchLoader(lambda step: step * 10, iter(lambda: next(steps), None)), 4)) == [0, 10, 50, 50]
    first = next(iter(RayDataModule(scene, rays=5, seed=1).train_dataloader()))
    assert torch.equal(first.pixels, RayDataModule(scene, rays=5, seed=1).draw(0).pixels)
