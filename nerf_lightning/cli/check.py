"""nerf_lightning check."""

from pathlib import Path
from typing import Annotated, Literal

from nerf_lightning.cli.command import Output, command
from nerf_lightning.utils.option_checks import Count, Ge


@command
def check(
    scene: Path,
    /,
    *,
    output: Output = None,
    resize: Count | None = 800,
    holdout: Annotated[int, Ge(2)] = 8,
    masked: Literal["auto", "ignore", "background"] = "auto",
    invert_masks: bool = False,
    bounded: Literal["auto", "true", "false"] = "auto",
    orientation: Literal["auto", "stored", "exif"] = "auto",
) -> list[str]:
    """Check a scene's photos and cameras before training: an HTML report, and a line per problem.

    Args:
        scene: A folder of photos, a video, or photos with cameras; see train --help for formats.
        output: Report to write; default: check.html in the current folder.
        resize: Longest side of the photos in pixels, as in training; null keeps their size.
        holdout: Every N-th photo is held out, unless the files define a split.
        masked: Meaning of masked-out pixels: ignore, background or auto.
        invert_masks: Masks are black where photos are kept.
        bounded: Whether the scene ends at its box: true, false, or auto from the photos.
        orientation: Rotation of photos: stored, exif, or auto to match their cameras.

    Returns:
        The printed lines.

    Raises:
        InputError: no scene, or a damaged one.
    """
    from nerf_lightning.check.report import assess_photos, check_before_training, record_warnings, render_check_page
    from nerf_lightning.dataset import PhotoLoadOptions, open_scene
    from nerf_lightning.utils.files import check_output_path, write_text

    path = check_output_path(output or "check.html")
    with record_warnings() as records:
        options = PhotoLoadOptions(resize, holdout, masked, invert_masks, bounded, orientation)
        loaded = open_scene(str(scene), options=options)
        remarks = check_before_training(loaded)
    warnings = [record.getMessage() for record in records]
    photos, poses = assess_photos(loaded)
    write_text(path, render_check_page(loaded, warnings + remarks, photos, poses))
    bad = [f"{photo.name}: {issue}" for photo in photos for issue in photo.issues]
    for line in remarks + bad:
        print(line)
    print(f"{loaded.name}: {len(photos)} photos, {len(bad)} remarks on them; {path}")
    return warnings + remarks + bad
