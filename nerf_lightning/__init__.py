"""nerf_lightning: photos in, radiance field out, on the machine you have.

The tree is the data flow, seven stages in order:

    photos -> cameras -> rays -> samples -> field -> renderer -> pixels

    capture/    before all: photos with printed tags become a scene, with lens and camera poses
    dataset/    photos and poses become a Scene; data modules draw pixels or rays from it
    cameras/    Cameras (K, c2w, size) turn pixel coordinates into Rays; Bounds say where the content is
    sampler/    Rays become Samples: where along each ray the field is asked
    model/      fields: position, direction -> density, rgb; encodings; 2D fields
    renderer/   Samples with density and rgb become colour, opacity, depth
    system/     NeRF2D and NeRF3D: LightningModules that hold step, loss, metrics, optimiser
    callbacks/  budget, guard, held-out PSNR, snapshots, orbit, checkpoints, progress, results.json
    build.py    config -> objects, the only place that instantiates
    device.py   which device does the work; limits.py what it takes at once
    view.py     a scene, or a trained run, in the browser: viewer/
    render/     films and pictures of a run; evaluate/ its figures, view by view; export/ files for other programs
    sweep.py    many runs from one command line; gallery.py draws what they made
    stability/  methods tried where they are known to fail
    chart/      speed against accuracy: which method is worth its time
    rightsize/  the smallest model that is good enough
    __main__.py the command line: compose -> build -> fit -> test -> results.json

Axis letters, the same everywhere: V views, H W pixels, C channels, R rays, S samples a ray, N packed samples
(or points), L levels or frequencies, F features. Cameras follow OpenCV: x right, y down, z forward; `c2w` maps camera
to world; pixel centres lie at +0.5. Lengths are in the scene's own unit, colours are sRGB in [0, 1].
"""

__version__ = "0.1.0"
