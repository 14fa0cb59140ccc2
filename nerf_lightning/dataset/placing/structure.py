"""Structure from motion with COLMAP (Schoenberger and Frahm 2016): photos -> lenses, cameras and points of the scene."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import imageio.v3 as imageio
import numpy as np

from nerf_lightning.dataset.formats.decode import THREADS, read_pixels
from nerf_lightning.dataset.placing.choose import FEWEST
from nerf_lightning.dataset.placing.lenses import Shot, focal_pixels, shot
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.utils.progress import counted, tracked

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

SIDE = 1600
"""Longest side in pixels of the copies in which COLMAP looks for features."""
GUESS = 1.2
"""Focal length in longest sides where nothing tells of it: COLMAP's own guess."""
FREE = 6
"""Numbers of the lens model OPENCV that are found from the photos: fewer photos get a simpler one."""
ALL_PAIRS = 150
"""Photos up to which each is compared with each; beyond, with those near it in order."""
NEAR, LANDMARKS = 20, 60
"""In order, on either side; and photos, evenly chosen, that are compared with each other too, so that a round closes."""
BLOCK, CHUNK = 25, 300
"""Photos whose features are in memory at a time, twice; pairs that are matched in one call."""
FEATURED = 4
"""Photos in one call that looks for features: enough for all cores, few enough that the bar moves."""


def reconstruct(photos: Sequence[Path], workspace: Path) -> "pycolmap.Reconstruction | None":
    """The largest model that COLMAP makes of photos; None where it makes none.

    Its cameras and pixels are those of the upright, full-size photos, its images have the photos' names. Photos of one size,
    camera and focal length share a lens, which starts from the focal length that they tell.

    Args:
        photos: of any sizes and cameras, in the order in which they were taken.
        workspace: an empty folder for copies and matches.

    Raises:
        InputError: a photo cannot be read.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # what fails is told in our own words
    pycolmap.set_random_seed(0)
    database, copies = workspace / "database.db", workspace / "photos"
    names = [f"{number:06d}.png" for number in range(len(photos))]  # no file name matters to COLMAP
    sizes = write_copies(photos, [copies / name for name in names])
    shots = [shot(photo, *size) for photo, size in zip(photos, sizes, strict=True)]
    find_features(database, copies, _lenses(database, names, shots))
    match_photos(database, names, workspace / "pairs.txt")
    models = _map(database, copies, workspace / "models", len(photos))
    model = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if model is not None:
        _full_size(model, dict(zip(names, shots, strict=True)), dict(zip(names, photos, strict=True)))
    return model


def pairs(count: int) -> list[tuple[int, int]]:
    """Which photos are compared: all with all, or of many those near each other in order, and a few with each other."""
    if count <= ALL_PAIRS:
        return list(itertools.combinations(range(count), 2))
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + NEAR + 1, count))}
    landmarks = np.linspace(0, count - 1, LANDMARKS).round().astype(int).tolist()
    return sorted(near | set(itertools.combinations(landmarks, 2)))


def write_copies(photos: Sequence[Path], copies: Sequence[Path]) -> list[tuple[int, int]]:
    """Writes upright copies of at most SIDE pixels, in a folder that is not there yet.

    Returns:
        Widths and heights of the upright photos.

    Raises:
        InputError: a photo cannot be read.
    """
    copies[0].parent.mkdir()

    def copy(photo: Path, file: Path) -> tuple[int, int]:
        pixels = np.ascontiguousarray(read_pixels(photo, upright=True)[..., :3])
        height, width = pixels.shape[:2]
        small = cv2.resize(pixels, fit_size(width, height, SIDE), interpolation=cv2.INTER_AREA)
        imageio.imwrite(file, small, compress_level=1)
        return width, height

    with ThreadPoolExecutor(THREADS) as pool:
        return list(tracked(pool.map(copy, photos, copies), len(photos), "reading photos"))


def _lenses(database: Path, names: Sequence[str], shots: Sequence[Shot]) -> dict[int, list[str]]:
    """Writes what is known of the lenses; their numbers, and the copies that share each."""
    import pycolmap

    groups: dict[Shot, list[str]] = {}
    for name, taken in zip(names, shots, strict=True):
        groups.setdefault(taken, []).append(name)
    members_of = {}
    with pycolmap.Database.open(database) as content:
        for taken, members in groups.items():
            width, height = fit_size(taken.width, taken.height, SIDE)
            told = focal_pixels(taken)
            focal = (told or GUESS * max(taken.width, taken.height)) * width / taken.width
            kind = "OPENCV" if len(members) >= FREE else "SIMPLE_RADIAL"
            camera = pycolmap.Camera.create_from_model_name(0, kind, focal, width, height)
            camera.has_prior_focal_length = told is not None
            members_of[content.write_camera(camera)] = members
            text = "%d photos of %dx%d by %s %s, focal length %s pixels"
            known = "unknown" if told is None else f"{told:.0f}"
            log.info(
                text, len(members), taken.width, taken.height, taken.make or "an unknown camera", taken.model, known
            )
    return members_of


def find_features(database: Path, copies: Path, members_of: Mapping[int, Sequence[str]]) -> None:
    """Writes the features of copies into a database.

    Args:
        copies: their folder.
        members_of: their names, by the number of their lens in the database.
    """
    import pycolmap

    calls = [
        (number, members[i : i + FEATURED])
        for number, members in members_of.items()
        for i in range(0, len(members), FEATURED)
    ]
    log.info("looking for features in them")
    with counted(sum(map(len, members_of.values())), "looking for features") as step:
        for number, members in calls:
            reader = pycolmap.ImageReaderOptions()
            reader.existing_camera_id = number
            pycolmap.extract_features(database, copies, members, pycolmap.CameraMode.AUTO, reader)
            step(len(members))


def match_photos(database: Path, names: Sequence[str], file: Path) -> None:
    """Matches the features of `pairs` of copies.

    Args:
        database: with their features.
        names: of the copies, in the order in which they were taken.
        file: to write; which pairs COLMAP is to match.
    """
    import pycolmap

    # Sorted by blocks, a call needs the features of few photos.
    jobs = sorted(pairs(len(names)), key=lambda pair: (pair[0] // BLOCK, pair[1] // BLOCK, pair))
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = file
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    log.info("matching %d pairs", len(jobs))
    with counted(len(jobs), "matching pairs of photos") as step:
        for start in range(0, len(jobs), CHUNK):
            chunk = jobs[start : start + CHUNK]
            file.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in chunk), encoding="utf-8")
            pycolmap.match_image_pairs(database, pairing_options=options, verification_options=verification)
            step(len(chunk))


def _map(database: Path, copies: Path, folder: Path, count: int) -> "dict[int, pycolmap.Reconstruction]":
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = FEWEST
    options.random_seed = 0
    folder.mkdir()
    log.info("placing them")
    with counted(count, "placing photos") as step:
        return pycolmap.incremental_mapping(
            database,
            copies,
            folder,
            options,
            initial_image_pair_callback=lambda: step(2),
            next_image_callback=lambda: step(1),
        )


def _full_size(model: "pycolmap.Reconstruction", shots: dict[str, Shot], photos: dict[str, Path]) -> None:
    """Changes a model of numbered copies into one of the photos; COLMAP's pixel centres are at +0.5, as ours are."""
    scales = {}
    for image in model.images.values():
        taken, camera = shots[image.name], model.cameras[image.camera_id]
        if image.camera_id not in scales:
            scales[image.camera_id] = np.array([taken.width / camera.width, taken.height / camera.height])
            camera.rescale(taken.width, taken.height)
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
        image.name = photos[image.name].name
    model.update_point_3d_errors()
