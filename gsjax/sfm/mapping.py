"""COLMAP's steps, through pycolmap: features, matching, mapping, and what they found.

Everything that pycolmap does to a database is in this file.
"""

import re
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from gsjax.runtime.machine import usable_cores
from gsjax.sfm.engine import Tell, colmap, rows_of, watched

MAX_FEATURES = 8192
_FEW_FEATURES = 100
_SCANT = "too few to place it, or not consistent"
_AGAIN, _AGAIN_EACH = 60, 5  # pairs matched again: in all, and of each image
# To begin with COLMAP wants 30. Half of that still cannot be chance: of random matches
# one in 4000 lies within the 12 px that count as agreeing.
_LAST_INLIERS = 15


class Shot(NamedTuple):
    """A photograph as the steps see it: a file, and the camera that took it.

    Attributes:
      file: name within the folder of photographs, as the database has it; without
        spaces, which COLMAP's lists of pairs cannot have.
      width, height: in px.
      focal: px, from EXIF; None where it is not known.
      camera: key of the camera: shots of equal keys share their intrinsics.
    """

    file: str
    width: int
    height: int
    focal: float | None
    camera: str


def exif_camera(path: Path) -> tuple[str, float | None]:
    """Name of the camera and focal length in px of the stored photograph.

    The length is that of a side × (mm / mm of the sensor), the sensor being known from
    EXIF or from COLMAP's table of cameras. Nothing is invented: None if it is absent
    or beyond what COLMAP takes for a camera, as what comes of zeros is; "" likewise.
    """
    bitmap = colmap().Bitmap.read(str(path), False)
    if bitmap is None:
        return "", None
    # The name ends in the stored size, whose sides change places in a turned photo.
    name = re.sub(r"-\d+x\d+$", "", bitmap.exif_camera_model() or "")
    focal = bitmap.exif_focal_length() or 0.0
    least, most = _focal_limits(max(bitmap.width, bitmap.height))
    return name, focal if least < focal < most else None  # nor if it is no number


def _focal_limits(side: int) -> tuple[float, float]:
    """Focal lengths in px between which COLMAP looks, of photographs of that side."""
    mapper = colmap().IncrementalMapperOptions()
    return mapper.min_focal_length_ratio * side, mapper.max_focal_length_ratio * side


def extract(
    database: Path, folder: Path, masks: Path | None, shots: Sequence[Shot], tell: Tell
) -> None:
    """SIFT features of all shots on the CPU, and their cameras, into the database.

    The images are entered one after the other beforehand: threads would number them in
    the order in which they happen to finish, and nothing could be repeated.
    """
    pycolmap = colmap()
    pycolmap.Database.open(database).close()  # makes it
    reader = pycolmap.ImageReaderOptions()
    for key in dict.fromkeys(shot.camera for shot in shots):
        names = [shot.file for shot in shots if shot.camera == key]
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, folder, mode, names, reader)
    _set_focal_lengths(database, shots)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = usable_cores()  # COLMAP knows nothing of containers
    options.sift.max_num_features = MAX_FEATURES
    if masks is not None:
        reader.mask_path = masks

    def work(token):
        pycolmap.extract_features(
            database,
            folder,
            image_names=[shot.file for shot in shots],
            camera_mode=pycolmap.CameraMode.PER_IMAGE,  # those already there stay
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    def look():
        return f"features {rows_of(database, 'keypoints')}/{len(shots)}"

    watched(work, look, tell)


def _set_focal_lengths(database: Path, shots: Sequence[Shot]) -> None:
    """Give the cameras what EXIF knows; the photographs in the folder have no EXIF."""
    by_file = {shot.file: shot for shot in shots}
    with closing(colmap().Database.open(database)) as opened:
        for image in opened.read_all_images():
            shot = by_file[image.name]
            if shot.focal is None:
                continue
            camera = opened.read_camera(image.camera_id)
            camera.params = [shot.focal, shot.width / 2, shot.height / 2, 0.0]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def match(database: Path, count: int, matcher: str, seed: int, tell: Tell) -> None:
    """Match the features of pairs of images, and keep what a motion explains.

    Args:
      count: of images.
      matcher: "exhaustive" for all pairs; "sequential" for neighbours by name: ten on,
        and then at distances that double.
    """
    pycolmap = colmap()
    every = matcher == "exhaustive"

    def work(token):
        step = pycolmap.match_exhaustive if every else pycolmap.match_sequential
        step(database, **_matching(seed), cancellation_token=token)

    def look():
        wanted = f"/{count * (count - 1) // 2}" if every else ""
        return f"matching pairs {rows_of(database, 'two_view_geometries')}{wanted}"

    watched(work, look, tell)


def _matching(seed: int, guided: bool = False) -> dict[str, Any]:
    """Arguments of every matching step."""
    pycolmap = colmap()
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = usable_cores()
    options.guided_matching = guided
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    return {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }


def reconstruct(
    database: Path,
    folder: Path,
    models: Path,
    seed: int,
    tell: Tell,
    *,
    start: Path | None = None,
) -> list[Any]:
    """Incremental mapping; the reconstructions, that of most images first.

    Args:
      models: folder for what COLMAP writes.
      start: folder of a model to be extended, by images of fewer inliers than one is
        begun with; or None.
    """
    pycolmap = colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    # Sums of several threads depend on who comes first: the last digits would vary.
    options.num_threads = 1
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    if start is not None:
        options.mapper.abs_pose_min_num_inliers = _LAST_INLIERS
    placed = 0

    def first():
        nonlocal placed
        placed = 2

    def more():
        nonlocal placed
        placed += 1

    def work(token):
        return pycolmap.incremental_mapping(
            database,
            folder,
            models,
            options=options,
            input_path="" if start is None else start,
            initial_image_pair_callback=first,
            next_image_callback=more,
            cancellation_token=token,
        )

    models.mkdir()
    found = watched(work, lambda: f"mapping: {placed} images placed", tell)
    for model in found.values():
        _leave_out_impossible(model, options.mapper)
    possible = [model for model in found.values() if model.num_reg_images() > 1]
    return sorted(possible, key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def _leave_out_impossible(model: Any, limits: Any) -> None:
    """Images that see no point, or by a camera that there can't be, are not placed.

    COLMAP leaves them out before it adjusts for the last time, and not after.
    """
    for image in list(model.images.values()):
        impossible = image.camera.has_bogus_params(
            limits.min_focal_length_ratio,
            limits.max_focal_length_ratio,
            limits.max_extra_param,
        )
        if impossible or not image.num_points3D:
            model.deregister_frame(image.frame_id)
    model.tear_down()  # else they are there still, without a pose


def match_again(database: Path, files: set[str], listing: Path, seed: int, tell: Tell):
    """Guided matching of the best pairs of images that could not be placed.

    The motion found by the first matching tells where to look for more: it gives up
    to ten times the matches, at about five times the cost, and so is for few pairs.

    Args:
      files: the images.
      listing: a file to write, of the pairs.

    Returns:
      How many pairs there were.
    """
    pycolmap = colmap()
    with closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs, left = [], dict.fromkeys(files, _AGAIN_EACH)
        for _count, ends in sorted(_verified(opened), reverse=True):
            ours = [names[end] for end in ends if left.get(names[end], 0)]
            if not ours or len(pairs) == _AGAIN:
                continue
            for name in ours:
                left[name] -= 1
            pairs.append(f"{names[ends[0]]} {names[ends[1]]}")
            opened.delete_two_view_geometry(*ends)
            opened.delete_matches(*ends)
    if not pairs:
        return 0
    listing.write_text("\n".join(pairs))
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listing

    def work(token):
        pycolmap.match_image_pairs(
            database,
            pairing_options=options,
            **_matching(seed, guided=True),
            cancellation_token=token,
        )

    watched(work, lambda: f"matching pairs again: {len(pairs)}", tell)
    return len(pairs)


def _verified(opened: Any) -> list[tuple[int, tuple[int, int]]]:
    """Matches that a motion explains, and the two images, of every pair with any."""
    pairs = zip(*opened.read_two_view_geometry_num_inliers())
    return [(int(n), colmap().pair_id_to_image_pair(pair)) for pair, n in pairs if n]


def why_not(database: Path, names: dict[str, str], placed: set[str]) -> dict[str, str]:
    """Why images were not placed, as far as their features and matches tell.

    Args:
      names: what users call each file.
      placed: the files that were.

    Returns:
      A reason for each file of ``names`` that was not.
    """
    with closing(colmap().Database.open(database)) as opened:
        files = {image.image_id: image.name for image in opened.read_all_images()}
        features = {
            name: opened.num_keypoints_for_image(key) for key, name in files.items()
        }
        matches: dict[str, dict[str, int]] = {}
        for count, ends in _verified(opened):
            first, second = (files[end] for end in ends)
            matches.setdefault(first, {})[second] = count
            matches.setdefault(second, {})[first] = count
    return {
        file: _reason(features.get(file, 0), matches.get(file, {}), names, placed)
        for file in names
        if file not in placed
    }


def _reason(
    features: int, matches: dict[str, int], names: dict[str, str], placed: set[str]
) -> str:
    """Why an image of so many features and matches with others was not placed."""
    if features < _FEW_FEATURES:
        return f"only {features} features in it: blurred, dark or without texture"
    if not matches:
        return f"none of its {features} features matches another image consistently"
    inside = {other: n for other, n in matches.items() if other in placed}
    best = max(inside or matches, key=matches.__getitem__)
    told = f"{matches[best]} matches at best, with {names[best]}"
    return f"{told}: {_SCANT if inside else 'not registered either'}"


def best_pair(database: Path) -> tuple[int, int]:
    """The most matches that two images have, and the pairs that have any."""
    with closing(colmap().Database.open(database)) as opened:
        counts = [count for count, _ in _verified(opened)]
    return max(counts, default=0), len(counts)
