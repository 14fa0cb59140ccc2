"""Photos that show no tag, placed by their texture against those that tags have placed."""

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import move, normalised, to_matrix
from nerf_lightning.capture.poses.tracks import Keypoint, linked, triangulated
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.dataset.placing.structure import SIDE, find_features, match_photos, write_copies
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.utils.libraries import require

log = logging.getLogger(__name__)

Pose = Float[np.ndarray, "4 4"]
REACH = 0.004
"""Reprojection distance up to which a match holds, in longest sides: 4 pixels at 1000."""
FEWEST = 15
"""Points that must agree on a pose: five times as many as settle one, so that chance matches do not."""
UNSURE = 0.01
"""Largest standard deviation of a pose: of its rotation in radians, and of its place in shares of its distance."""
SHARE = 0.25
"""Of the photo's matches that must agree."""
HINT = "; pip install 'nerf_lightning[colmap]' places such photos by their texture"


@dataclass(frozen=True)
class Found:
    """A photo placed by its texture."""

    w2c: Pose
    reprojection_px: float
    """Root mean square over the points that agree, pixels of the photo."""
    points: int
    """That agree."""


def place_by_texture(
    paths: Sequence[Path], lens: Lens, w2c: Mapping[str, Pose], lost: Sequence[str]
) -> tuple[dict[str, Found], dict[str, str]]:
    """Places photos against points that placed photos show, as long as more get placed; nothing else moves.

    Features are matched by COLMAP (Schoenberger and Frahm 2016); points are triangulated from the known poses, so that scale
    and frame stay those of the tags.

    Args:
        paths: of all photos of the lens.
        lens: calibrated.
        w2c: world to camera of the photos that are placed, by name.
        lost: names of those to place.

    Returns:
        What was found, by name; and why the others were not placed.

    Raises:
        InputError: pycolmap is not installed.
    """
    require("colmap", "pycolmap", purpose="the optional extra that places photos by their texture")
    log.info("placing %d photos without tags by their texture", len(lost))
    names = [path.name for path in paths]
    tangents, matches = _matched(paths, lens)
    tracks = linked(matches)
    poses, found, counts = dict(w2c), dict[str, Found](), dict[str, int]()
    limit = REACH * max(lens.width, lens.height) / lens.fx
    while True:
        known = {names.index(name): pose for name, pose in poses.items()}
        points = triangulated(tracks, tangents, known, limit)
        fresh = {}
        for name in lost:
            if name in found:
                continue
            number = names.index(name)
            pairs = [(point, tangents[number][k]) for track, point in points for n, k in track if n == number]
            fit, counts[name] = pose_from_points(pairs, limit)
            if fit is not None:
                pose, rms, agreeing = fit
                fresh[name] = Found(pose, rms * lens.fx, agreeing)
        if not fresh:
            break
        found |= fresh
        poses |= {name: photo.w2c for name, photo in fresh.items()}
    log.info("%d of them placed", len(found))
    reasons = {
        name: f"no tag found, and only {counts[name]} points of its texture agree with the other photos"
        for name in lost
        if name not in found
    }
    return found, reasons


def pose_from_points(
    pairs: Sequence[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "2"]]], limit: float
) -> tuple[tuple[Pose, float, int] | None, int]:
    """A pose from points of the world and where they are seen: RANSAC, then the least squared distance.

    Args:
        pairs: points, and x / z and y / z in the camera's frame.
        limit: distance of x / z and y / z up to which a pair agrees.

    Returns:
        World to camera, root mean square distance, and how many pairs agree: None where these are too few, or do not settle
        the pose. And how many agree in any case.
    """
    if len(pairs) < FEWEST:
        return None, len(pairs)
    points, seen = (np.array(column, np.float64) for column in zip(*pairs, strict=True))
    cv2.setRNGSeed(0)
    done, turn, shift, chosen = cv2.solvePnPRansac(
        points, seen, np.eye(3), None, None, None, False, 10000, limit, 0.9999, None, cv2.SOLVEPNP_SQPNP
    )
    agree = np.zeros(len(points), bool)
    if not done or chosen is None:
        return None, 0
    agree[chosen.reshape(-1)] = True
    for _ in range(3):
        if agree.sum() < max(FEWEST, SHARE * len(points)):
            return None, int(agree.sum())
        turn, shift = cv2.solvePnPRefineLM(points[agree], seen[agree], np.eye(3), None, turn, shift)
        pose = to_matrix(np.concatenate([turn.reshape(3), shift.reshape(3)]))
        there = move(pose, points)
        off = np.linalg.norm(there[:, :2] / there[:, 2:] - seen, axis=1)
        agree = (off < limit) & (there[:, 2] > 0)
    count = int(agree.sum())
    if count < max(FEWEST, SHARE * len(points)):
        return None, count
    rms = float(np.sqrt((off[agree] ** 2).mean()))
    _, jacobian = cv2.projectPoints(points[agree], turn, shift, np.eye(3), None)
    J = jacobian[:, :6]
    deviations = np.sqrt(np.diagonal(np.linalg.pinv(J.T @ J)) * rms**2 / 2)
    distance = float(np.median(there[agree, 2]))
    sure = deviations[:3].max() < UNSURE and deviations[3:].max() < UNSURE * distance
    return ((pose, rms, count) if sure else None), count


def _matched(
    paths: Sequence[Path], lens: Lens
) -> tuple[list[Float[np.ndarray, "K 2"]], list[tuple[Keypoint, Keypoint]]]:
    """Features of each photo as x / z and y / z, and which of them are the same, each as (photo, number of the feature)."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(0)
    width, height = fit_size(lens.width, lens.height, SIDE)
    x, y = width / lens.width, height / lens.height
    parameters = [lens.fx * x, lens.fy * y, lens.cx * x, lens.cy * y, *lens.distortion, 0.0, 0.0, 0.0]
    with tempfile.TemporaryDirectory() as workspace:
        folder, database = Path(workspace) / "photos", Path(workspace) / "database.db"
        copies = [f"{number:06d}.png" for number in range(len(paths))]
        write_copies(paths, [folder / name for name in copies])
        with pycolmap.Database.open(database) as content:
            camera = pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=parameters)
            camera.has_prior_focal_length = True
            number = content.write_camera(camera)
        find_features(database, folder, {number: copies})
        match_photos(database, copies, Path(workspace) / "pairs.txt")
        matches: list[tuple[Keypoint, Keypoint]] = []
        with pycolmap.Database.open(database) as opened:
            ids = {image.name: image.image_id for image in opened.read_all_images()}
            pixels = [np.asarray(opened.read_keypoints(ids[name]), np.float64)[:, :2] for name in copies]
            numbers = {ids[name]: place for place, name in enumerate(copies)}
            for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
                i, j = (numbers[image] for image in pycolmap.pair_id_to_image_pair(pair))
                matches += [((i, int(a)), (j, int(b))) for a, b in np.asarray(geometry.inlier_matches)]
    return [normalised(lens, p / [x, y]) if len(p) else p.reshape(0, 2) for p in pixels], matches
