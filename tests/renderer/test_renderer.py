import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import photometric_loss
from nerf_lightning.model import FieldOutput
from nerf_lightning.renderer import VolumeRenderer, composite_over
from nerf_lightning.sampler import UniformSampler
from tests.helpers.ragged_samples import make_ragged_samples

SCENE = (0.2, 0.4, 0.6)


def along_z(count: int, dtype: torch.dtype = torch.float32) -> Rays:
    return Rays(torch.zeros(count, 3, dtype=dtype), torch.tensor([0, 0, 1], dtype=dtype).repeat(count, 1))


def fixed(density: Tensor, rgb: Tensor):
    """A field with this density and color per sample."""
    return lambda positions, directions: (density, rgb)


def test_render_matches_loop_over_samples(kernels: str):
    counts = [4, 0, 6]
    samples, rays = make_ragged_samples(counts), along_z(3)
    density, rgb = 5 * torch.rand(10), torch.rand(10, 3)
    behind = torch.rand(3, 3)
    output = VolumeRenderer()(rays, samples, fixed(density, rgb), behind)
    i = 0
    for ray, count in enumerate(counts):
        left, color, depth = 1.0, torch.zeros(3), 0.0
        for _ in range(count):
            weight = left * float(-torch.expm1(-density[i] * samples.dt[i]))
            color, depth, left = color + weight * rgb[i], depth + weight * float(samples.t[i]), left - weight
            i += 1
        torch.testing.assert_close(output.rgb[ray], color + left * behind[ray], rtol=1e-4, atol=1e-5)
        assert float(output.opacity[ray]) == pytest.approx(1 - left, abs=1e-5)
        assert float(output.depth[ray]) == pytest.approx(depth / (1 - left) if count else 0, rel=1e-4)


@pytest.mark.parametrize("distance", [0.3, 2.5])
def test_render_thin_wall_depth_is_its_distance(distance: float, kernels: str):
    box, rays = Bounds(torch.tensor([[-1.0, -1, 0], [1, 1, 3]])), along_z(2)

    def wall(positions: Tensor, directions: Tensor):
        return 1e6 * ((positions[:, 2] - distance).abs() < 0.02).float(), torch.ones(len(positions), 3)

    output = VolumeRenderer("black")(rays, UniformSampler(box, 300)(rays, lambda x: x[:, 0]), wall)
    torch.testing.assert_close(output.depth, torch.full((2,), distance), atol=0.03, rtol=0)
    torch.testing.assert_close(output.opacity, torch.ones(2))


@pytest.mark.parametrize(
    ("background", "color", "sigma"),
    [
        ("white", (1, 1, 1), 0.0),
        ([0.1, 0.5, 1], (0.1, 0.5, 1), 0.3),
        ("random", SCENE, 0.3),
    ],
)
def test_render_uncovered_part_shows_background(background, color, sigma, kernels: str):
    samples = make_ragged_samples([5])
    red = torch.tensor([1.0, 0, 0]).repeat(5, 1)
    output = VolumeRenderer(background, SCENE)(along_z(1), samples, fixed(torch.full((5,), sigma), red))
    opacity = -torch.expm1(-sigma * samples.dt.sum())
    torch.testing.assert_close(output.opacity[0], opacity)
    torch.testing.assert_close(output.rgb[0], opacity * red[0] + (1 - opacity) * torch.tensor(color).float())
    assert (float(output.depth) == 0) == (sigma == 0)


def test_render_without_gradient_returns_no_sample_tensors():
    samples, residual = make_ragged_samples([5]), torch.rand(5, 3)
    output = VolumeRenderer(view_loss_weight=1.0)(
        along_z(1), samples, lambda *_: FieldOutput(torch.ones(5), torch.rand(5, 3), residual)
    )
    assert output.weights is None and output.view_residual is None


def test_background_random_is_mean_over_colors():
    background = VolumeRenderer("random", SCENE).background
    assert torch.equal(background.expand(2), torch.tensor(SCENE).expand(2, 3))
    assert torch.equal(VolumeRenderer("white").background.expand(2, is_training=True), torch.ones(2, 3))
    premultiplied, opacity = torch.tensor([[0.3, 0.1, 0.2]]), torch.tensor([0.4])
    pixels = torch.tensor([[200, 100, 50, 180]], dtype=torch.uint8)

    def measure_errors(colors: Tensor) -> Tensor:
        truth = composite_over(pixels.expand(len(colors), 4), colors)
        return (premultiplied + (1 - opacity) * colors - truth).square().mean(1)

    expected = measure_errors(torch.rand(200_000, 3, generator=Generator().manual_seed(0))).mean()
    gray = measure_errors(background.expand(1, is_training=True))[0]
    rendered = premultiplied, opacity, background.expand(1, is_training=True), pixels, None
    loss, on_opacity, errors = photometric_loss(*rendered, None, background.variance)
    assert loss == gray < 0.9 * expected and errors[0] == loss + on_opacity
    torch.testing.assert_close(errors[0], expected, rtol=1e-2, atol=0.0)
    assert not photometric_loss(*rendered, torch.tensor([False]), background.variance)[1]


@pytest.mark.parametrize("background", ["green", [0.1, 0.2, 0.3, 0.4], [0, 0, 1.5]])
def test_renderer_bad_background_is_refused(background):
    with pytest.raises(InputError, match="renderer.background"):
        VolumeRenderer(background)


def test_near_loss_fades_out():
    samples, rays = make_ragged_samples([4]), Rays(torch.zeros(1, 3), torch.eye(3)[:1])
    density = torch.ones(4, requires_grad=True)

    def field(positions: Tensor, directions: Tensor):
        return density, torch.ones(4, 3)

    renderer = VolumeRenderer(near_loss_weight=0.01)
    output = renderer(rays, samples, field)
    first, half, *others = (renderer.losses(output, samples, progress) for progress in (0.0, 0.35, 0.7, 1.0))
    assert float(first["near"].detach()) == pytest.approx(2 * float(half["near"].detach())) and first["near"] > 0
    assert others == [{}, {}]


def test_gradients_shrink_near_camera():
    samples, rays = make_ragged_samples([4]), Rays(torch.zeros(1, 3), torch.eye(3)[:1])
    outputs, gradients = [], []
    for distance in (0.0, 2.0):
        density, rgb = torch.ones(4, requires_grad=True), torch.full((4, 3), 0.5, requires_grad=True)
        renderer = VolumeRenderer(gradient_scaling_distance=distance, half_size=float(samples.t[2]) / 2)
        output = renderer(rays, samples, lambda *_, field=(density, rgb): field)
        outputs.append(output.rgb.detach())
        gradients.append(torch.autograd.grad(output.rgb.sum(), (density, rgb)))
    scale = torch.stack([samples.t[0] / samples.t[2], samples.t[1] / samples.t[2], *torch.ones(2)]) ** 2
    assert torch.equal(*outputs)
    torch.testing.assert_close(gradients[1], (gradients[0][0] * scale, gradients[0][1] * scale[:, None]))
