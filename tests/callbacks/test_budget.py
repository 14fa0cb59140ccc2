import pytest

from nerf_lightning.callbacks import Budget
from nerf_lightning.errors import InputError


def test_budget_paused_clock_does_not_advance(clock, system, trainer_with):
    budget = Budget(seconds=100)
    trainer = trainer_with(budget)
    clock.wait(7)
    assert budget.seconds == 0
    budget.on_train_start(trainer, system)
    clock.wait(10)
    assert budget.seconds == 10
    with budget.pause():
        clock.wait(1000)
        assert budget.seconds == 10
        with budget.pause():
            clock.wait(1000)
        clock.wait(1000)
        assert budget.seconds == 10, "the inner pause does not start the clock"
    with pytest.raises(ZeroDivisionError), budget.pause():
        clock.wait(1000)
        raise ZeroDivisionError
    clock.wait(6)
    assert budget.seconds == 16, "runs again after an error"
    budget.on_train_end(trainer, system)
    clock.wait(1000)
    with budget.pause():
        clock.wait(1000)
    clock.wait(1000)
    assert budget.seconds == 16, "a pause after the end does not start it"


@pytest.mark.parametrize(
    ("steps", "seconds", "step", "spent", "share", "left", "pause"),
    [
        (200, None, 50, 30, 0.25, 90, 120),
        (200, None, 300, 30, 1, 0, 30),
        (200, 60, 50, 30, 0.5, 30, 60),
        (200, 60, 150, 30, 0.75, 10, 40),
        (None, 8, 50, 9, 1, 0, 30),
        (200, None, 0, 0, 0, None, 30),
    ],
)
def test_budget_two_limits_follow_nearer(steps, seconds, step, spent, share, left, pause, clock, system, trainer_with):
    budget = Budget(steps, seconds)
    budget.on_train_start(trainer_with(budget), system)
    clock.wait(spent)
    assert budget.progress(step) == share and budget.seconds_left(step) == pytest.approx(left)
    assert budget.render_allowance_seconds(step) == pytest.approx(pause), "as long as training, or half a minute"


def test_budget_exhausted_stops_training(clock, system, trainer_with):
    budget = Budget(steps=3, seconds=100)
    trainer = trainer_with(budget)
    budget.on_train_start(trainer, system)
    for step, progress in ((1, 1 / 3), (2, 2 / 3), (3, 1)):
        budget.on_train_batch_start(trainer, system, None, 0)
        assert budget.state.progress == (step - 1) / 3
        assert not trainer.should_stop
        trainer.global_step = step
        budget.on_train_batch_end(trainer, system, None, None, 0)
        assert budget.state.progress == progress
    assert trainer.should_stop


def test_budget_resumed_continues_clock(clock, system, trainer_with):
    first, second = Budget(seconds=20), Budget(seconds=20)
    first.on_train_start(trainer_with(first), system)
    clock.wait(15)
    second.load_state_dict(first.state_dict())
    clock.wait(1000)
    trainer = trainer_with(second)
    second.on_train_start(trainer, system)
    assert second.seconds == 15 and not trainer.should_stop
    clock.wait(5)
    third = Budget(seconds=20)
    third.load_state_dict(second.state_dict())
    third.on_train_start(trainer, system)
    assert trainer.should_stop, "a finished run has nothing left"


def test_budget_without_limit_raises():
    with pytest.raises(InputError, match="budget"):
        Budget()
