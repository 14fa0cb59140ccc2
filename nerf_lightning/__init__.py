"""nerf_lightning: photos in, radiance field out, on the machine you have.

The tree is the data flow, seven stages in order:

    photos -> cameras -> rays -> samples -> field -> renderer -> pixels

    capture/    before all: photos with printed tags become a scene, with lens and camera poses
    dataset/    photos and poses become a Scene; data modules draw pixels or rays from it
    cameras/    Cameras (K, c2w, size) turn pixel coordinates into Rays; Bounds say where the content is
    sampler/    Rays become Samples: where along each ray the field is evaluated
    model/      fields: position, direction -> density, rgb; encodings; 2D fields
    kernels/    the hot loops of all of these: a plain reference, and a fast version for CPUs
    renderer/   Samples with density and rgb become color, opacity, depth
    system/     NeRF2D and NeRF3D: LightningModules that hold step, loss, metrics, optimizer
    callbacks/  budget, divergence recovery, validation, snapshots, orbit, checkpoints, progress, results.json
    config/     command line -> configuration -> objects; build.py is the only place that instantiates
    training/   one run, from a configuration to the files in its folder; sweeps: many runs from one command line
    api.py      the same from Python: load_scene, train, load_run
    runs/       run folders and compact files: finding, reading (untrusted), opening

Each command is a typed function in cli/, which calls its room: capture/, check/, view/, render/, evaluate/, export/,
comparison/ (speed against accuracy), sizing/ (the smallest model that is good enough), stability/ (methods where they
are known to fail, on scenes of synthetic/). What they all draw with is in drawing/; what knows nothing of fields, in utils/.

Axis letters, the same everywhere: V views, H W pixels, C channels, R rays, S samples a ray, N packed samples
(or points), L levels or frequencies, F features. Cameras follow OpenCV: x right, y down, z forward; `c2w` maps camera
to world; pixel centers lie at +0.5. Lengths are in the scene's own unit, colors are sRGB in [0, 1].
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerf_lightning.api import Run, View, compare, load_run, load_scene, rightsize, train

__version__ = "0.2.0"
__all__ = ["Run", "View", "compare", "load_run", "load_scene", "rightsize", "train"]


def __getattr__(name: str) -> Any:
    """Imports the API on first access: the command line's help and errors need nothing heavy."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from nerf_lightning import api

    return getattr(api, name)
