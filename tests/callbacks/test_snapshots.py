import pytest

from nerf_lightning.callbacks import Budget, Snapshots
from nerf_lightning.errors import InputError


@pytest.mark.parametrize(("steps", "expected"), [(None, [10, 20, 50, 100]), ([1, 7, 200], [1, 7]), ([], [])])
def test_list_snapshot_steps_default_is_1_2_5(steps, expected):
    assert Snapshots(steps=steps).list_snapshot_steps(150) == expected


def test_snapshots_due_steps_are_written_with_clock_stopped(clock, system, trainer_with, tmp_path):
    budget, snapshots = Budget(steps=9), Snapshots(steps=[2, 4], view=3)
    trainer = trainer_with(budget, snapshots)
    budget.on_train_start(trainer, system)
    for trainer.global_step in range(1, 6):
        clock.wait(1)
        snapshots.on_train_batch_end(trainer, system, None, None, 0)
    snapshots.on_train_end(trainer, system)
    names = sorted(path.name for path in (tmp_path / "snapshots").iterdir())
    assert names == ["step_0000002.png", "step_0000004.png", "step_0000005.png"]
    assert system.evaluated == [0, 3, 3, 3] and budget.seconds == 5
    snapshots.on_train_end(trainer, system)
    assert len(system.evaluated) == 4, "what is there already is not taken again"


@pytest.mark.parametrize("view", [-1, 10])
def test_snapshots_missing_view_raises(view, trainer_with):
    with pytest.raises(InputError, match="callbacks.snapshots.view"):
        Snapshots(view=view).check(trainer_with().datamodule)
