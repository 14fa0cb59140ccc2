import torch

from nerf_lightning.utils.seeding import Stream, step_generator


def draw(seed: int, stream: Stream, step: int) -> tuple[float, ...]:
    return tuple(torch.rand(3, generator=step_generator(seed, stream, step)).tolist())


def test_the_same_seed_stream_and_step_draw_the_same():
    torch.manual_seed(1)
    first = draw(3, Stream.STEP, 77)
    torch.manual_seed(2)
    assert draw(3, Stream.STEP, 77) == first


def test_every_other_seed_stream_or_step_draws_something_else():
    draws = [draw(seed, stream, step) for seed in (0, 1, 2, 1234, 2**31) for stream in Stream for step in range(200)]
    assert len(set(draws)) == len(draws)


def test_the_first_draws_of_consecutive_steps_look_independent():
    values = torch.tensor([draw(0, Stream.BATCH, step)[0] for step in range(2000)])
    assert abs(float(values.mean()) - 0.5) < 0.03 and abs(float(values.std()) - 12**-0.5) < 0.02
    correlation = torch.corrcoef(torch.stack([values[:-1], values[1:]]))[0, 1]
    assert abs(float(correlation)) < 0.08


def test_seeds_may_be_any_whole_number():
    for seed, step in ((-5, 0), (2**63, 2**31), (0, 10**12)):
        assert len(draw(seed, Stream.STEP, step)) == 3
