import math
from itertools import pairwise

import pytest

from nerf_lightning.system import constant, cosine, exponential

SCHEDULES = pytest.mark.parametrize("schedule", [constant, exponential, cosine])
STEPS = [i / 200 for i in range(201)]


@SCHEDULES
def test_schedule_warmup_rises_linearly(schedule):
    assert 0 < schedule(0.0, 0, 0.3) < 0.05, "small, but no step is lost"
    rising = [schedule(p, 0, 0.3) / schedule(p, 0, 0.0) for p in STEPS if p <= 0.3]
    assert rising[-1] == pytest.approx(1)
    slopes = [b - a for a, b in pairwise(rising)]
    assert min(slopes) > 0 and max(slopes) == pytest.approx(min(slopes)), "in a straight line"


@pytest.mark.parametrize(("schedule", "final_factor"), [(exponential, 0.1), (cosine, 0.2)])
def test_schedule_end_reaches_final_factor(schedule, final_factor):
    values = [schedule(p, 0, 0.0, final_factor) for p in STEPS]
    assert values[0] == 1 and values[-1] == pytest.approx(final_factor)
    assert all(a > b for a, b in pairwise(values))
    halfway = math.sqrt(final_factor) if schedule is exponential else (1 + final_factor) / 2
    assert values[100] == pytest.approx(halfway)


@SCHEDULES
def test_schedule_inverse_sqrt_after_lowers_factor(schedule):
    assert schedule(0.5, 0, inverse_sqrt_after=100) == schedule(0.5, 9999) == schedule(0.5)
    assert schedule(0.5, 300, inverse_sqrt_after=100) == pytest.approx(schedule(0.5) / 2)
    assert schedule(0.5, 9900, inverse_sqrt_after=100) == pytest.approx(schedule(0.5) / 10)
