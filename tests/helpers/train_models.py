"""Trains every shipped model for a moment and takes a fingerprint of its weights; as a process of its own it prints them.

python train_models.py FOLDER STOP     (interrupted after STOP steps and resumed; 0: in one go)
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from nerf_lightning.callbacks import Checkpoints
from nerf_lightning.config.compose import compose_config
from nerf_lightning.system import correction_trial, photo_quality
from nerf_lightning.training.train import train

SCENE = [
    *("dataset=bricks", "dataset.size=16", "dataset.train_views=12", "dataset.val_views=1", "dataset.rays=256"),
    *("dataset.samples=2048", "sampler.samples=32", "sampler.resolution=16", "callbacks.orbit=null"),
]
SMALL_BRICKS = ["dataset=bricks", "dataset.size=24", "dataset.train_views=8", "dataset.val_views=1"]
PICTURE = ["+experiment=picture", "dataset.max_side=24", "dataset.pixels=256", "callbacks.pictures=null"]
GROWING = ["model.base_resolution=8", "model.max_resolution=16", "model.growth_end=1"]
HASHGRID = ["model.num_levels=3", "model.max_resolution=32", "model.log2_hashmap_size=10", "model.width=16"]
REFINED = ["refine=both", "refine.focal=true", "refine.affine=true", "refine.vignetting=true"]
MODELS = {
    "hashgrid": [*SCENE, "refine=auto", *HASHGRID],
    "voxels": [*SCENE, "recipe=voxels_small", *GROWING],
    "tensorf": [*SCENE, *REFINED, "recipe=tensorf_small", *GROWING],
    "mlp": [*SCENE, "recipe=mlp_small", "model.width=16"],
    "hashgrid2d": PICTURE,
    **{name: [*PICTURE, "model.width=32"] for name in ("picture_mlp", "fourier", "siren")},
}
OTHER_SEED = "siren, another seed"
NUM_STEPS = 14


photo_quality.JOINT_STEPS = photo_quality.PER_CAMERA_STEPS = 1  # held-out photos are not what is compared


class StopTraining(Exception):
    """Training is to end here."""


@patch.dict(correction_trial.MIN_ERROR_REDUCTION, poses=-1.0, exposure=-1.0)  # refine=auto begins with its first trial
@patch.multiple(correction_trial, FIRST_TRIAL_STEP=2, EARLY_TRIAL_STEPS=2)
def train_fingerprints(folder: Path, stop: int) -> dict[str, str]:
    save = Checkpoints.on_train_batch_end

    def save_and_stop(self: Checkpoints, trainer: Any, *rest: Any) -> None:
        save(self, trainer, *rest)
        if trainer.global_step == stop:
            self.save(trainer, "last.ckpt")
            raise StopTraining

    prints = {}
    for name in [*MODELS, OTHER_SEED]:
        model, seed, run = name.partition(",")[0], int(name == OTHER_SEED), folder / name
        options = [f"model={model}", f"seed={seed}", "threads=2", f"budget.steps={NUM_STEPS}", "~logger"]
        cfg = compose_config([*MODELS[model], *options], run)
        last = run / "checkpoints" / "last.ckpt"
        if stop:
            Checkpoints.on_train_batch_end = save_and_stop  # type: ignore[method-assign]
            try:
                train(cfg)
            except StopTraining:
                Checkpoints.on_train_batch_end = save  # type: ignore[method-assign]
            assert json.loads((run / "results.json").read_text())["steps"] == stop
        train(cfg, last if stop else None)
        prints[name] = hash_weights(run / "checkpoints" / "last.ckpt")
    return prints


def hash_weights(checkpoint: Path) -> str:
    """Of all weights and buffers, bit by bit."""
    state = torch.load(checkpoint, weights_only=True)
    assert state["global_step"] == NUM_STEPS
    digest = hashlib.sha256()
    for key, value in sorted(state["state_dict"].items()):
        digest.update(f"{key} {tuple(value.shape)} {value.dtype}".encode() + value.numpy().tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    print(json.dumps(train_fingerprints(Path(sys.argv[1]), int(sys.argv[2]))))
