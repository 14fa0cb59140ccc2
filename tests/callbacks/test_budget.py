import time

import pytest
import torch

from nerf_lightning.callbacks import Budget
from nerf_lightning.errors import InputError


def test_budget_paused_clock_stands(clock, system, trainer_with):
    budget = Budget(seconds=100)
    trainer = trainer_with(budget)
    clock.wait(7)
    assert budget.seconds == 0
    budget.on_train_start(trainer, system)
    clock.wait(10)
    assert budget.seconds == 10
    with budget.paused():
        clock.wait(1000)
        assert budget.seconds == 10
        with budget.paused():
            clock.wait(1000)
        clock.wait(1000)
        assert budget.seconds == 10, "the inner pause does not start the clock"
    clock.wait(5)
    assert budget.seconds == 15
    with pytest.raises(ZeroDivisionError), budget.paused():
        clock.wait(1000)
        raise ZeroDivisionError
    clock.wait(1)
    assert budget.seconds == 16, "runs again after an error"
    budget.on_train_end(trainer, system)
    clock.wait(1000)
    with budget.paused():
        clock.wait(1000)
    clock.wait(1000)
    assert budget.seconds == 16, "a pause after the end does not start it"


@pytest.mark.parametrize(
    ("steps", "seconds", "step", "spent", "expected"),
    [
        (200, None, 50, 30, 0.25),
        (200, None, 300, 30, 1),
        (None, 60, 50, 30, 0.5),
        (200, 60, 50, 30, 0.5),
        (200, 60, 150, 30, 0.75),
        (200, 60, 50, 61, 1),
    ],
)
def test_progress_two_limits_follows_nearer(steps, seconds, step, spent, expected, clock, system, trainer_with):
    budget = Budget(steps, seconds)
    budget.on_train_start(trainer_with(budget), system)
    clock.wait(spent)
    assert budget.progress(step) == expected


@pytest.mark.parametrize(
    ("steps", "seconds", "step", "spent", "left", "rendering"),
    [
        (200, None, 50, 30, 90, 120),
        (None, 60, 50, 20, 40, 60),
        (200, 90, 100, 30, 30, 60),
        (None, 8, 50, 9, 0, 30),
        (200, None, 0, 0, None, 30),
    ],
)
def test_seconds_left_two_limits_follow_nearer(
    steps, seconds, step, spent, left, rendering, clock, system, trainer_with
):
    budget = Budget(steps, seconds)
    budget.on_train_start(trainer_with(budget), system)
    clock.wait(spent)
    assert budget.seconds_left(step) == pytest.approx(left)
    assert budget.render_seconds(step) == pytest.approx(rendering), "as long as training, and at least half a minute"


def test_budget_spent_stops_training(clock, system, trainer_with):
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


def test_budget_resumed_continues_where_it_stopped(clock, system, trainer_with):
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


def test_budget_without_limit_is_refused():
    with pytest.raises(InputError, match="budget"):
        Budget()


def test_budget_alone_counts_undisturbed_work(clock, system, trainer_with, monkeypatch):
    worked = {"thread": 50.0, "process": 500.0}
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(time, "thread_time", lambda: worked["thread"])
    monkeypatch.setattr(time, "process_time", lambda: worked["process"])
    plain, alone = Budget(seconds=100), Budget(seconds=100, alone=True)
    for budget in (plain, alone):
        budget.on_train_start(trainer_with(budget), system)

    def step(wall: float, thread: float, process: float) -> None:
        clock.wait(wall)
        worked["thread"] += thread
        worked["process"] += process
        for budget in (plain, alone):
            budget.on_train_batch_end(trainer_with(budget), system, None, None, 0)

    step(0.1, 0.1, 0.2)
    step(0.1, 0.0, 0.2)
    assert plain.seconds == pytest.approx(0.2) and alone.seconds == pytest.approx(0.2), "other threads did all the work"
    for _ in range(10):
        step(0.3, 0.12, 0.24)
    assert plain.seconds == pytest.approx(3.2)
    assert alone.seconds == pytest.approx(12 * 0.1), "waits for a core do not count, nor what they do to the caches"
    with alone.paused():
        clock.wait(50)
        worked["thread"] += 50
    for _ in range(20):
        step(0.2, 0.2, 0.4)
    step(0.2, 0.2, 0.4)
    before = alone.seconds
    step(0.2, 0.2, 0.4)
    assert alone.seconds == pytest.approx(before + 0.2), "steps that grow count in full before long"
    assert alone.progress(0) == alone.seconds / 100
