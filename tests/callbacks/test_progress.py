from nerf_lightning.callbacks import Budget
from nerf_lightning.callbacks.progress import describe_progress
from nerf_lightning.utils.progress import format_duration


def test_format_duration_seconds_match_expected():
    times = {9: "0:09", 59.4: "0:59", 59.6: "1:00", 3599.6: "1:00:00", 3723: "1:02:03"}
    assert [format_duration(seconds) for seconds in times] == list(times.values())


def test_describe_progress_after_ten_seconds_shows_eta(clock, system, trainer_with):
    budget = Budget(seconds=100)
    trainer = trainer_with(budget)
    budget.on_train_start(trainer, system)
    budget.render_timer.add_timing(100, 1.0)
    trainer.global_step = 1
    clock.wait(9)
    assert describe_progress(trainer) == ["step 1"]
    clock.wait(11)
    assert describe_progress(trainer) == ["step 1", "left 1:20"]
    with budget.pause_to_render(trainer, "snapshot"):
        assert describe_progress(trainer)[-1] == "left 1:20: snapshot"
