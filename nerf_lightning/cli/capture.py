"""nerf_lightning capture and print-tags."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from nerf_lightning.cli.command import command
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import check_output_path, expand_user_path
from nerf_lightning.utils.option_checks import Ge, Le

TagSize = Annotated[float, Ge(1e-4), Le(1)]
"""Meters, above the size of a printer's dots; larger numbers are probably in another unit."""
BoardSquares = Annotated[int, Ge(3), Le(1000)]
"""Squares along a side of a ChArUco board."""


@command
def capture(
    *,
    calibration: Path,
    photos: Path,
    tag_size: TagSize,
    output: Annotated[Path, Parameter(alias="-o")] = Path("scene.npz"),
    dictionary: str = "auto",
    layout: Path | None = None,
    board_columns: BoardSquares | None = None,
    board_rows: BoardSquares | None = None,
    board_square: TagSize | None = None,
    resize: Annotated[int, Ge(0)] = 300,
    holdout: Annotated[int, Ge(2)] = 10,
) -> Any:
    """Create a scene from photos of a subject with printed ArUco tags in view, and a report.

    Photos without visible tags are registered by their texture, if pycolmap is installed.

    Args:
        calibration: Folder of photos of only the tags, from many angles.
        photos: Folder of photos of the subject with tags in view, in the order taken, with the same zoom.
        tag_size: Side of a tag's black square, meters.
        output: Scene to write, FILE.npz; cameras.json, calibration.yaml and FILE_report/ go to its folder.
        dictionary: OpenCV's name of the tags' family, such as DICT_4X4_50; auto tries the common ones.
        layout: sheet_2x3, or a YAML file of tag positions; default: estimated from the photos.
        board_columns: Squares of a ChArUco board from left to right, if used instead of tags.
        board_rows: Squares of the board from top to bottom.
        board_square: Side of a square of the board, meters.
        resize: Longest side of the scene's photos, pixels; 0 keeps their size.
        holdout: Every N-th photo is held out for validation.

    Raises:
        InputError: an invalid option or photo.
    """
    target = check_output_path(output)
    if target.suffix != ".npz":
        raise InputError("capture", "output", str(output), "a file name that ends in .npz")
    board = (board_columns, board_rows, board_square)
    if any(board) and not all(board):
        raise InputError("capture", "board_columns, board_rows, board_square", str(board), "all three, or none")
    from nerf_lightning.capture.pipeline import capture_scene
    from nerf_lightning.capture.report.report import write_report
    from nerf_lightning.capture.tags.board import Board

    captured = capture_scene(
        expand_user_path(calibration),
        expand_user_path(photos),
        tag_size,
        target,
        dictionary=dictionary,
        layout=layout,
        board=Board(board_columns, board_rows, board_square) if board_columns and board_rows and board_square else None,
        max_side=resize or None,
        holdout=holdout,
    )
    write_report(captured, report := target.with_name(f"{target.stem}_report"))
    placed = sum(photo.c2w is not None for photo in captured.photos)
    print(f"{placed} of {len(captured.photos)} photos placed; wrote {target}, cameras.json and calibration.yaml")
    print(f"look at {report}, then: nerf_lightning train +experiment=capture dataset.path={target}")
    return captured


@command
def print_tags(
    sheet: Path, /, *, tag_size: TagSize = 0.06, dictionary: str = "DICT_4X4_50", layout: Path = Path("sheet_2x3")
) -> None:
    """Write an A4 page of ArUco tags, to be printed at 100 % scale.

    Args:
        sheet: FILE.pdf to write.
        tag_size: Side of a tag's black square, meters.
        dictionary: OpenCV's name of the tags' family.
        layout: sheet_2x3 (six tags), or a YAML file of tag positions.

    Raises:
        InputError: no .pdf, an unknown family or layout, or tags that do not fit on the page.
    """
    from nerf_lightning.capture.tags.printout import write_sheet_pdf
    from nerf_lightning.capture.tags.tag_layout import read_layout

    write_sheet_pdf(read_layout(layout, dictionary, tag_size), check_output_path(sheet))
