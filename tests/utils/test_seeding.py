import torch

from nerf_lightning.utils.seeding import Stream, step_generator


def draw(seed: int, stream: Stream, step: int) -> tuple[float, ...]:
    return tuple(torch.rand(3, generator=step_generator(seed, stream, step)).tolist())


def test_step_generator_same_step_repeats():
    torch.manual_seed(1)
    first = draw(3, Stream.STEP, 77)
    torch.manual_seed(2)
    assert draw(3, Stream.STEP, 77) == first


def test_step_generator_differs_by_seed_stream_and_step():
    draws = [draw(seed, stream, step) for seed in (0, 1, 2, 1234, 2**31) for stream in Stream for step in range(200)]
    assert len(set(draws)) == len(draws)


def test_step_generator_consecutive_steps_are_uncorrelated():
    values = torch.tensor([draw(0, Stream.BATCH, step)[0] for step in range(2000)])
    assert abs(float(values.mean()) - 0.5) < 0.03 and abs(float(values.std()) - 12**-0.5) < 0.02
    correlation = torch.corrcoef(torch.stack([values[:-1], values[1:]]))[0, 1]
    assert abs(float(correlation)) < 0.08
