import pytest

from nerf_lightning.callbacks import Budget, Throughput


def test_throughput_speeds_average_since_last_entry(clock, system, trainer_with):
    budget, throughput = Budget(steps=100), Throughput(every=4)
    trainer = trainer_with(budget, throughput)
    budget.on_train_start(trainer, system)
    throughput.on_train_start(trainer, system)
    for trainer.global_step in range(1, 9):
        clock.wait(1 if trainer.global_step <= 4 else 3)
        with budget.pause():
            clock.wait(100)
        throughput.on_train_batch_end(trainer, system, None, None, 0)
    (first, at_first), (second, at_second) = (call.args for call in trainer.logger.log_metrics.call_args_list)
    assert (at_first, at_second) == (4, 8)
    # The system says 30 rays, 90 samples and an error of 0.01 at each step.
    assert first["speed/rays_per_second"] == pytest.approx(30) and second["speed/rays_per_second"] == pytest.approx(10)
    assert first["speed/samples_per_ray"] == second["speed/samples_per_ray"] == 3
    assert first["train/psnr"] == pytest.approx(20) and first["loss/photometric"] == 0.01
    assert first["lr/field"] == 0.1
    assert (first["speed/train_seconds"], second["speed/train_seconds"]) == (4, 16)
    assert throughput.rays == 240
