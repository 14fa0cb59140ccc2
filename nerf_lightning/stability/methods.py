"""The methods: shipped recipes as they are, and controls that are known to fail."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """A model with its settings."""

    kind: str
    """Of the model; conditions choose options by it."""
    options: tuple[str, ...]
    guard: bool = True
    flat: bool = False
    """Whether it fits pictures."""
    control: bool = False
    """Whether it is here because it fails, at least without the guard."""
    guarded: str | None = None
    """The same method with the guard, which must rescue what fails here."""


UNGUARDED = ("callbacks.guard.attempts=0",)
RELU = (
    *("model=mlp", "model.depth=2", "model.width=32", "model.skip=null", "optimizer.lr=5e-3"),
    *("sampler=stratified", "sampler.samples=32", "dataset.rays=256", "dataset.samples=null"),
)
FLAT = ("+experiment=picture", "dataset.pixels=1024")
COURSE = ("+experiment=picture_mlp", "dataset.pixels=1024", "model.frequencies=null")
"""The course's network, without warm-up: at ten times its learning rate, 1e-1, it dies."""

METHODS = {
    "hashgrid": Method("hashgrid", ("recipe=hashgrid_small",)),
    "voxels": Method("voxels", ("recipe=voxels_small",)),
    "tensorf": Method("tensorf", ("recipe=tensorf_small",)),
    "mlp": Method("mlp", ("recipe=mlp_small",)),
    "relu mlp": Method("mlp", RELU, control=True),
    "relu mlp, no guard": Method("mlp", (*RELU, *UNGUARDED), guard=False, control=True, guarded="relu mlp"),
    "2D hashgrid": Method("hashgrid2d", FLAT, flat=True),
    "2D mlp": Method("picture_mlp", (*FLAT, "model=picture_mlp"), flat=True),
    "2D fourier": Method("fourier", (*FLAT, "model=fourier"), flat=True),
    "2D siren": Method("siren", (*FLAT, "model=siren"), flat=True),
    "2D course mlp": Method("picture_mlp", COURSE, flat=True, control=True),
    "2D course mlp, no guard": Method(
        "picture_mlp", (*COURSE, *UNGUARDED), False, flat=True, control=True, guarded="2D course mlp"
    ),
}
