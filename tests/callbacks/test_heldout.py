from nerf_lightning.callbacks import Budget, HeldOut


def test_heldout_measures_at_fractions_with_clock_stopped(clock, system, trainer_with):
    budget, held_out = Budget(steps=10), HeldOut([0.2, 0.5, 0.55], views=2)
    trainer = trainer_with(budget, held_out)
    budget.setup(trainer, system, "fit")
    budget.on_train_start(trainer, system)
    assert held_out.latest is None and held_out.pixels_left(trainer) == 6 * 12 * 16
    for step in range(1, 11):
        clock.wait(1)
        trainer.global_step = step
        budget.on_train_batch_end(trainer, system, None, None, 0)
        held_out.on_train_batch_end(trainer, system, None, None, 0)
    # Two views a time: 11 and 12 dB, then 13 and 14, then 15 and 16.
    assert held_out.curve == [[2, 2, 11.5], [5, 5, 13.5], [6, 6, 15.5]]
    assert system.asked == [0, *[2, 7] * 3], "one to see how long a view takes"
    assert held_out.latest == 15.5 and held_out.pixels_left(trainer) == 0
    assert budget.seconds == 10


def test_heldout_step_passing_several_marks_adds_one_row(clock, system, trainer_with):
    budget, held_out = Budget(steps=10), HeldOut([0.2, 0.5, 0.55], views=1)
    trainer = trainer_with(budget, held_out)
    trainer.global_step = 5
    system.state.advance(0.52)
    held_out.on_train_batch_end(trainer, system, None, None, 0)
    resumed = HeldOut([0.2, 0.5, 0.55], views=1)
    resumed.load_state_dict(held_out.state_dict())
    trainer.callbacks = [budget, resumed]
    for progress, trainer.global_step in ((0.53, 6), (0.56, 7)):
        system.state.advance(progress)
        resumed.on_train_batch_end(trainer, system, None, None, 0)
    assert resumed.curve == [[0, 5, 11], [0, 7, 12]], "what was measured before the pause is not measured again"
