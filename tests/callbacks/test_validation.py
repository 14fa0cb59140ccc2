from nerf_lightning.callbacks import Budget, PeriodicValidation


def test_validation_fractions_are_measured_with_clock_stopped(clock, system, trainer_with):
    budget, validation = Budget(steps=10), PeriodicValidation([0.2, 0.5, 0.55], views=2)
    trainer = trainer_with(budget, validation)
    budget.setup(trainer, system, "fit")
    budget.on_train_start(trainer, system)
    assert validation.latest_psnr is None and validation.count_remaining_pixels(trainer) == 6 * 12 * 16
    for step in range(1, 11):
        clock.wait(1)
        trainer.global_step = step
        budget.on_train_batch_end(trainer, system, None, None, 0)
        validation.on_train_batch_end(trainer, system, None, None, 0)
    # Two views a time: 11 and 12 dB, then 13 and 14, then 15 and 16.
    assert validation.curve == [[2, 2, 11.5], [5, 5, 13.5], [6, 6, 15.5]]
    assert system.evaluated == [0, *[2, 7] * 3], "one to see how long a view takes"
    assert validation.latest_psnr == 15.5 and validation.count_remaining_pixels(trainer) == 0
    assert budget.seconds == 10


def test_validation_step_passing_several_fractions_adds_one_row(clock, system, trainer_with):
    budget, validation = Budget(steps=10), PeriodicValidation([0.2, 0.5, 0.55], views=1)
    trainer = trainer_with(budget, validation)
    trainer.global_step = 5
    system.state.set_progress(0.52)
    validation.on_train_batch_end(trainer, system, None, None, 0)
    resumed = PeriodicValidation([0.2, 0.5, 0.55], views=1)
    resumed.load_state_dict(validation.state_dict())
    trainer.callbacks = [budget, resumed]
    for progress, trainer.global_step in ((0.53, 6), (0.56, 7)):
        system.state.set_progress(progress)
        resumed.on_train_batch_end(trainer, system, None, None, 0)
    assert resumed.curve == [[0, 5, 11], [0, 7, 12]], "what was measured before the pause is not measured again"
