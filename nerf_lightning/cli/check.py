"""nerf_lightning check."""

from pathlib import Path
from typing import Annotated, Literal

from nerf_lightning.cli.command import Output, command
from nerf_lightning.utils.options import AtLeast, Count


@command
def check(
    scene: Path,
    /,
    *,
    output: Output = None,
    resize: Count | None = 800,
    holdout: Annotated[int, AtLeast(2)] = 8,
    masked: Literal["auto", "unknown", "empty"] = "auto",
    invert_masks: bool = False,
    bounded: Literal["auto", "true", "false"] = "auto",
    orientation: Literal["auto", "stored", "exif"] = "auto",
) -> list[str]:
    """Check a scene's photos and cameras before training: one page, and a line for all that looks wrong.

    Args:
        scene: A folder of photos, a video, or photos with cameras; train --help lists the formats.
        output: The page; default: check.html where the command runs.
        resize: Longest side of the photos in pixels, as in training; null for their size.
        holdout: Every N-th photo is held out, unless the files say which.
        masked: What masks leave out: unknown, empty or auto.
        invert_masks: Masks are black where the photo is kept.
        bounded: Whether nothing is outside the box: true, false, or auto by the photos.
        orientation: How photos are turned: stored, exif, or auto as their cameras say.

    Returns:
        The lines.

    Raises:
        InputError: where there is no scene, or a damaged one.
    """
    from nerf_lightning.check.findings import check_page, find_doubts, judge_photos, record_warnings
    from nerf_lightning.dataset import PhotoLoadOptions, open_scene
    from nerf_lightning.utils.files import output_path, write_text

    path = output_path(output or "check.html")
    with record_warnings() as records:
        options = PhotoLoadOptions(resize, holdout, masked, invert_masks, bounded, orientation)
        found = open_scene(str(scene), options=options)
        doubts = find_doubts(found)
    warnings = [record.getMessage() for record in records]
    photos, poses = judge_photos(found)
    write_text(path, check_page(found, warnings + doubts, photos, poses))
    bad = [f"{photo.name}: {trouble}" for photo in photos for trouble in photo.troubles]
    for line in doubts + bad:
        print(line)
    print(f"{found.name}: {len(photos)} photos, {len(bad)} remarks on them; {path}")
    return warnings + doubts + bad
