"""nerf_lightning evaluate."""

from typing import Annotated, Any, Literal

from nerf_lightning.cli.command import Device, Output, Photos, RunPath, command
from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import find_run
from nerf_lightning.utils.option_checks import Ge


@command
def evaluate(
    run: RunPath = None,
    /,
    *,
    photos: Photos = None,
    split: Literal["val", "test"] = "val",
    worst: Annotated[int, Ge(1)] = 3,
    output: Output = None,
    device: Device = "auto",
) -> dict[str, Any]:
    """Evaluate a run: PSNR, SSIM and LPIPS of each held-out view.

    LPIPS needs torchvision, its AlexNet weights in torch.hub's folder (nothing is downloaded), and views of 64 pixels.

    Args:
        split: val, or test (as in publications) if the scene's files define a test split.
        worst: Number of worst views to draw.
        output: Folder for worst.png and views.json; default: evaluation/ in the run.

    Returns:
        The content of views.json: `mean` and `views`.

    Raises:
        InputError: an invalid device, run, photos or split.
    """
    from dataclasses import replace

    from nerf_lightning.drawing.contact_sheet import make_contact_sheet
    from nerf_lightning.drawing.panels import make_result_panel, write_png
    from nerf_lightning.evaluate.metrics import format_table, measure_views, to_json
    from nerf_lightning.runs.open import get_output_folder, open_run
    from nerf_lightning.runs.reload import reload_data
    from nerf_lightning.utils.device import resolve_device
    from nerf_lightning.utils.files import check_output_path, write_json
    from nerf_lightning.utils.machine import describe_device

    where, source = resolve_device(device), find_run(run)
    loaded = open_run(source, where)
    data = reload_data(loaded.cfg, loaded.scene, photos)
    if split == "test":
        if data.scene.test is None:
            raise InputError("evaluate", "split", "these photos have no test split", hint="give split=val")
        data.scene = replace(data.scene, val=data.scene.test)
    folder = get_output_folder(source) / "evaluation" if output is None else check_output_path(output)
    metrics, results = measure_views(loaded.system, data, worst)
    evaluation = to_json(metrics, source, data.scene.describe(), where)
    write_json(folder / "views.json", evaluation)
    order = sorted(results, key=lambda view: results[view].psnr)
    captions = [f"view {view}, {metrics.psnr[view]:.2f} dB, SSIM {metrics.ssim[view]:.3f}" for view in order]
    panels = [make_result_panel(results[view], "") for view in order]
    write_png(folder / "worst.png", make_contact_sheet(panels, captions, columns=1))
    print(format_table(metrics))
    views = f"{len(metrics)} {'test' if split == 'test' else 'held-out'} views on {describe_device(where)}"
    print(f"{data.scene.name}: {metrics.psnr.mean():.2f} dB over {views}; {folder}/worst.png, views.json")
    return evaluation
