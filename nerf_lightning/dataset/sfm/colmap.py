"""Structure from motion with COLMAP (Schoenberger and Frahm 2016): photos -> lenses, poses and points."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from nerf_lightning.dataset.formats import image_files
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.utils.progress import progress_bar, track_progress

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

MIN_PHOTOS = 3
"""Registered photos for a scene."""
COPY_SIDE_PX = 1600
"""Longest side of the copies for feature detection."""
MIN_OPENCV_PHOTOS = 6
"""Photos of a lens needed for the model OPENCV; fewer photos get SIMPLE_RADIAL."""
MAX_EXHAUSTIVE_PHOTOS = 150
"""Photos up to which matching is exhaustive; sequential beyond."""
SEQUENTIAL_WINDOW, NUM_LOOP_PHOTOS = 20, 60
"""Sequential neighbors on either side; and evenly spaced photos that are matched exhaustively for loop closure."""
PAIRS_PER_CALL = 300
"""Pairs per matching call, few enough for a smooth progress bar."""
MAX_ERROR_FRACTION = 0.004
"""Largest reprojection error with known poses, relative to the longest side: 4 pixels at 1000."""
MIN_POSE_POINTS = 15
"""Minimum inliers of a pose: five times the minimal set, to exclude chance."""
MAKE_TAG, MODEL_TAG, FOCAL_TAG, FOCAL_35MM_TAG = 0x010F, 0x0110, 0x920A, 0xA405
"""EXIF tag ids from which COLMAP derives the focal length, in millimeters."""


def reconstruct(photos: Sequence[Path], workspace: Path) -> "pycolmap.Reconstruction | None":
    """Reconstructs photos with COLMAP and returns the largest model; None if there is none.

    Cameras and pixels refer to the upright, full-size photos; images have the photos' names. Photos of one size, camera and
    focal length share a lens, initialized from EXIF.

    Args:
        photos: of any sizes and cameras, in the order taken.
        workspace: empty folder for copies and matches.

    Raises:
        InputError: a photo is unreadable.
    """
    import pycolmap

    database, copies, sizes = match_photos(photos, workspace)
    options = pycolmap.IncrementalPipelineOptions(min_model_size=MIN_PHOTOS, random_seed=0)
    (workspace / "models").mkdir()
    with progress_bar(len(photos), "registering photos") as step:
        callbacks: dict[str, Any] = {
            "initial_image_pair_callback": lambda: step(2),
            "next_image_callback": lambda: step(1),
        }
        models = pycolmap.incremental_mapping(database, copies, workspace / "models", options, **callbacks)
    model = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if model is not None:
        _rescale_model(model, photos, sizes)
    return model


def register_with_known_poses(
    photos: Sequence[Path], lens: Intrinsics, known: Mapping[int, Float[np.ndarray, "4 4"]], workspace: Path
) -> dict[int, tuple[Float[np.ndarray, "4 4"], float]]:
    """Registers photos with those of known pose; known poses, lens, scale and frame stay fixed.

    COLMAP triangulates points from the known poses and registers the other photos one after the other.

    Args:
        photos: all photos, of one lens, in the order taken.
        known: world to camera, by photo index.
        workspace: empty folder for copies and matches.

    Returns:
        World to camera and RMS reprojection error in pixels, by index, of the newly registered photos.
    """
    import pycolmap

    parameters = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.opencv_distortion, 0.0, 0.0, 0.0]
    camera = pycolmap.Camera(model="FULL_OPENCV", width=lens.width, height=lens.height, params=parameters)
    camera.has_prior_focal_length = True
    camera.rescale(*fit_size(lens.width, lens.height, COPY_SIDE_PX))
    database, copies, _ = match_photos(photos, workspace, camera)
    start = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as content:
        (camera,), images = content.read_all_cameras(), content.read_all_images()
    start.add_camera_with_trivial_rig(camera)
    for image in images:
        if parse_index(image) in known:
            placed = pycolmap.Image(name=image.name, camera_id=camera.camera_id, image_id=image.image_id)
            start.add_image_with_trivial_frame(placed, pycolmap.Rigid3d(known[parse_index(image)][:3]))
    folder, output = workspace / "known", workspace / "models"
    folder.mkdir()
    output.mkdir()
    options = _fixed_pose_options(MAX_ERROR_FRACTION * max(camera.width, camera.height))
    pycolmap.triangulate_points(start, database, copies, folder, options=options).write_binary(folder)
    models = pycolmap.incremental_mapping(database, copies, output, options, input_path=folder)
    scale = lens.width / camera.width
    registered = {}
    for model in models.values():
        for image in model.images.values():
            if image.has_pose and parse_index(image) not in known and image.num_points3D >= MIN_POSE_POINTS:
                w2c = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
                registered[parse_index(image)] = w2c, scale * _compute_rms_error(image, model)
    return registered


def match_photos(
    photos: Sequence[Path], workspace: Path, camera: "pycolmap.Camera | None" = None
) -> tuple[Path, Path, list[tuple[int, int]]]:
    """Detects features in copies of photos and matches them.

    Args:
        photos: in the order taken.
        workspace: empty folder.
        camera: camera of all copies; None derives it from EXIF.

    Returns:
        COLMAP's database, the folder of the copies, and widths and heights of the upright photos.

    Raises:
        InputError: a photo is unreadable.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # callers report failures
    pycolmap.set_random_seed(0)
    database, copies = workspace / "database.db", workspace / "photos"
    reader = pycolmap.ImageReaderOptions()
    if camera is not None:
        with pycolmap.Database.open(database) as content:
            reader.existing_camera_id = content.write_camera(camera)
    copies.mkdir()
    with ThreadPoolExecutor(image_files.MAX_DECODE_THREADS) as pool:
        written = pool.map(_write_copy, photos, [copies / make_copy_name(number) for number in range(len(photos))])
        lenses = list(track_progress(written, len(photos), "reading photos"))
    for lens in dict.fromkeys(lenses):
        names = [make_copy_name(number) for number, other in enumerate(lenses) if other == lens]
        log.info("detecting features in %d photos of %dx%d", len(names), *lens[0])
        reader.camera_model = "OPENCV" if len(names) >= MIN_OPENCV_PHOTOS else "SIMPLE_RADIAL"
        pycolmap.extract_features(database, copies, names, pycolmap.CameraMode.SINGLE, reader)
    pairs = pair_photos(len(photos))
    options = pycolmap.ImportedPairingOptions(match_list_path=workspace / "pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    log.info("matching %d pairs", len(pairs))
    with progress_bar(len(pairs), "matching pairs of photos") as step:
        for first in range(0, len(pairs), PAIRS_PER_CALL):
            chunk = pairs[first : first + PAIRS_PER_CALL]
            lines = [f"{make_copy_name(i)} {make_copy_name(j)}\n" for i, j in chunk]
            (workspace / "pairs.txt").write_text("".join(lines), encoding="utf-8")
            pycolmap.match_image_pairs(database, pairing_options=options, verification_options=verification)
            step(len(chunk))
    return database, copies, [size for size, _ in lenses]


def pair_photos(count: int) -> list[tuple[int, int]]:
    """Lists the pairs to match: exhaustive, or for many photos sequential with loop closure."""
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        return list(itertools.combinations(range(count), 2))
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + SEQUENTIAL_WINDOW + 1, count))}
    landmarks = np.linspace(0, count - 1, NUM_LOOP_PHOTOS).round().astype(int).tolist()
    return sorted(near | set(itertools.combinations(landmarks, 2)))


def make_copy_name(number: int) -> str:
    """File name of a photo's copy, since COLMAP cannot read every name."""
    return f"{number:06d}.jpg"


def parse_index(image: "pycolmap.Image") -> int:
    """Parses the photo index from a copy's name."""
    return int(Path(image.name).stem)


def _write_copy(photo: Path, file: Path) -> tuple[tuple[int, int], bytes]:
    """Writes a reduced upright JPEG and returns the full size and the EXIF tags, which identify the lens."""
    image = Image.fromarray(np.ascontiguousarray(image_files.read_pixels(photo, upright=True)[..., :3]))
    tags = read_lens_tags(photo)
    small = image.resize(fit_size(*image.size, COPY_SIDE_PX), Image.Resampling.BOX)
    small.save(file, quality=98, subsampling=0, exif=tags)
    return image.size, tags


def read_lens_tags(photo: Path) -> bytes:
    """Reads the lens-related EXIF tags of a photo; empty if missing or broken."""
    tags, kept = image_files.read_header(photo).tags, Image.Exif()
    try:
        kept.update({tag: str(tags[tag]) for tag in (MAKE_TAG, MODEL_TAG) if tag in tags})
        if (focal := float(tags.get(FOCAL_TAG, 0))) > 0:
            kept.get_ifd(image_files.EXIF_IFD_TAG)[FOCAL_TAG] = IFDRational(Fraction(focal).limit_denominator(1000))
        if (focal := float(tags.get(FOCAL_35MM_TAG, 0))) > 0:
            kept.get_ifd(image_files.EXIF_IFD_TAG)[FOCAL_35MM_TAG] = round(focal)
        return kept.tobytes()
    except image_files.DECODE_ERRORS:
        return b""


def _fixed_pose_options(max_error: float) -> "pycolmap.IncrementalPipelineOptions":
    """COLMAP options with fixed known poses and lens, and a largest reprojection error in pixels."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(random_seed=0, multiple_models=False, fix_existing_frames=True)
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.abs_pose_min_num_inliers = MIN_POSE_POINTS
    options.mapper.abs_pose_max_error = options.mapper.filter_max_reproj_error = max_error
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    options.triangulation.ignore_two_view_tracks = False  # two views of known pose suffice
    return options


def _rescale_model(model: "pycolmap.Reconstruction", photos: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> None:
    """Rescales a model from the copies to the photos; COLMAP's pixel centers are at +0.5, as ours."""
    scales = {}
    for image in model.images.values():
        number, camera = parse_index(image), model.cameras[image.camera_id]
        if image.camera_id not in scales:
            scales[image.camera_id] = np.divide(sizes[number], [camera.width, camera.height])
            camera.rescale(*sizes[number])
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
        image.name = photos[number].name
    model.update_point_3d_errors()


def _compute_rms_error(image: "pycolmap.Image", model: "pycolmap.Reconstruction") -> float:
    """Computes the RMS reprojection error of a photo's points, in pixels."""
    points = [point for point in image.points2D if point.has_point3D()]
    projected = [image.project_point(model.points3D[point.point3D_id].xyz) for point in points]
    squares = [((p - point.xy) ** 2).sum() for p, point in zip(projected, points, strict=True) if p is not None]
    return float(np.sqrt(np.mean(squares)))
