"""The capture verb's configuration -> the work. Heavy imports wait until the configuration is checked."""

from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import output_path, user_path
from nerf_lightning.utils.options import AtLeast, AtMost, Count, check_options

NEEDED = {
    "tags": {"calibration": "FOLDER", "photos": "FOLDER", "tags.size": "0.06"},
    "colmap": {"photos": "FOLDER"},
}
"""By kind of poses: what must be given, and an example."""

PRINTED, PRINTED_FAMILY, PRINTED_SIZE = "sheet_2x3", "DICT_4X4_50", 0.06
"""What `print` writes by default."""


def options(
    print: str | None,
    poses: str,
    calibration: str | None,
    photos: str | None,
    output: str,
    tags: dict,
    resize: Count | None,
    holdout: Annotated[int, AtLeast(2)],
    orbit: str | None,
    name: str | None,
) -> None:
    """The keys of conf/capture.yaml, for checking."""


TagSize = Annotated[float, AtLeast(1e-4), AtMost(10)]
"""Metres: printers make no smaller dots, and photos hold no larger tags."""


def tag_options(size: TagSize | None, dictionary: str, layout: str, board: dict) -> None:
    """The keys of its `tags`."""


def board_options(columns: Count | None, rows: Count | None, square: float | None) -> None:
    """The keys of its `tags.board`."""


def capture_from(cfg: DictConfig) -> None:
    """Does what the configuration says.

    Raises:
        InputError: a key that is missing or wrong, and whatever is wrong with the photos.
    """
    plain = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)  # a DictConfig gives nothing else
    given = {str(key): value for key, value in plain.items()}
    check_options("", options, given)
    check_options("tags", tag_options, given["tags"])
    check_options("tags.board", board_options, given["tags"]["board"])
    tags = given["tags"]
    if given["print"] is not None:
        _print(tags, output_path(given["print"]))
        return
    if given["poses"] not in NEEDED:
        raise InputError("config", "poses", given["poses"], "tags or colmap")
    for key, example in NEEDED[given["poses"]].items():
        if OmegaConf.select(cfg, key) is None:
            raise InputError("config", key, "nothing", "a value", f"give {key}={example}")
    if given["poses"] == "tags" and tags["layout"] == "charuco":
        for key, value in tags["board"].items():
            if value is None:
                raise InputError("config", f"tags.board.{key}", "nothing", "a value", "count the board's squares")

    from rich.console import Console

    from nerf_lightning.capture.outputs import Packing
    from nerf_lightning.capture.poses.structure import capture_without_tags
    from nerf_lightning.capture.report.write import draw_cameras, write_report
    from nerf_lightning.capture.run import capture
    from nerf_lightning.capture.tags.board import Board

    packing = Packing(output_path(given["output"]), given["resize"], given["holdout"], given["orbit"], given["name"])
    folder, report = user_path(given["photos"]), packing.output.with_name(packing.output.stem + "_report")
    if given["poses"] == "colmap":
        photos, scene = capture_without_tags(folder, packing)
        draw_cameras(photos, scene, report)
    else:
        board = Board(**tags["board"]) if tags["layout"] == "charuco" else None
        sheets, size = user_path(given["calibration"]), float(tags["size"])
        found = capture(sheets, folder, size, packing, tags["dictionary"], tags["layout"], board)
        write_report(found, report)
        photos = found.photos
    placed, console = sum(photo.status == "placed" for photo in photos), Console(highlight=False, soft_wrap=True)
    output = packing.output
    console.print(
        f"{placed} of {len(photos)} photos placed; {output}, with cameras.json and calibration.yaml beside it"
    )
    console.print(f"look at {report}, then: python -m nerf_lightning +experiment=capture dataset.path={output}")


def _print(tags: dict[str, Any], file: Path) -> None:
    """Writes the page of a known sheet."""
    from nerf_lightning.capture.tags.layout import read_layout
    from nerf_lightning.capture.tags.printout import write_page

    sheet = PRINTED if tags["layout"] == "auto" else tags["layout"]
    family = PRINTED_FAMILY if tags["dictionary"] == "auto" else tags["dictionary"]
    write_page(read_layout(Path(sheet), family, float(tags["size"] or PRINTED_SIZE)), file)
