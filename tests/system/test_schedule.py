import math

import pytest

from nerf_lightning.system import constant, cosine, exponential

SCHEDULES = pytest.mark.parametrize("schedule", [constant, exponential, cosine])
STEPS = [i / 200 for i in range(201)]


@SCHEDULES
@pytest.mark.parametrize("warmup", [0.05, 0.3])
def test_schedule_warmup_rises_linearly(schedule, warmup):
    assert 0 < schedule(0.0, 0, warmup) < 0.05, "small, but no step is lost"
    assert schedule(warmup, 0, warmup) == pytest.approx(schedule(warmup, 0, 0.0))
    rising = [schedule(p, 0, warmup) / schedule(p, 0, 0.0) for p in STEPS if p <= warmup]
    assert all(a < b for a, b in zip(rising, rising[1:], strict=False))
    slopes = [b - a for a, b in zip(rising, rising[1:], strict=False)]
    assert max(slopes) == pytest.approx(min(slopes)), "in a straight line"


@pytest.mark.parametrize(("schedule", "final"), [(exponential, 0.1), (exponential, 0.01), (cosine, 0.0), (cosine, 0.2)])
def test_schedule_falls_to_final_factor(schedule, final):
    values = [schedule(p, 0, 0.0, final) for p in STEPS]
    assert values[0] == 1 and values[-1] == pytest.approx(final)
    assert all(a > b for a, b in zip(values, values[1:], strict=False))
    halfway = math.sqrt(final) if schedule is exponential else (1 + final) / 2
    assert values[100] == pytest.approx(halfway)


@SCHEDULES
def test_schedule_inverse_root_lowers_rate_of_many_steps(schedule):
    assert schedule(0.5, 0, inverse_root=100) == schedule(0.5, 9999) == schedule(0.5)
    assert schedule(0.5, 300, inverse_root=100) == pytest.approx(schedule(0.5) / 2)
    assert schedule(0.5, 9900, inverse_root=100) == pytest.approx(schedule(0.5) / 10)
