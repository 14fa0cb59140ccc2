"""What the configuration's nodes become."""

from functools import partial
from pathlib import Path

from nerf_lightning.config.build import make
from nerf_lightning.config.compose import composed
from nerf_lightning.system import exponential


def test_what_a_step_calls_is_the_function_itself(tmp_path: Path):
    """Not something that examines it once more at each call."""
    made = make(composed(["schedule=exponential", "schedule.final=0.25"], tmp_path), "schedule")
    assert type(made) is partial
    assert made.func is exponential
    assert made(1.0, 0) == exponential(1.0, 0, final=0.25) == 0.25
