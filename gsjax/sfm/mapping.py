"""COLMAP's steps through pycolmap: features, matching and incremental mapping.

All access to COLMAP's database is in this file.
"""

import re
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform

from gsjax.data import heif
from gsjax.data.exif import blank_jpeg, exif_of
from gsjax.data.image_header import image_size
from gsjax.runtime.machine import usable_cores
from gsjax.sfm.engine import Progress, colmap, count_rows, run_cancellable

MAX_FEATURES = 8192
# Those that structure from motion can estimate without a prior calibration.
CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
    *("THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION"),
)
_FEW_FEATURES = 100
_SMALL = 512  # px, longer side of the JPEG from which COLMAP reads EXIF
_WITH_EXIF = (".jpg", ".jpeg", *heif.SUFFIXES)
_MAX_GUIDED_PAIRS, _MAX_GUIDED_PAIRS_PER_IMAGE = 60, 5
# COLMAP starts with 30. 15 are still not chance: one in 4000 random matches lies within
# the 12 px that count as an inlier.
MIN_INLIERS_EXTENDED = 15
_COLLAPSED = 1e-4  # median distance of cameras to the next, of the largest distance
_LEAST_IMAGES = 3  # of a further model
_GROUPED = 30  # inliers of a pair that tell that both images show one scene


class MapperLimits(NamedTuple):
    """Limits of incremental mapping, by default COLMAP's.

    Attributes:
      forward: share of the motion of the first pair that may be forward.
      angle: degrees of triangulation that the first pair needs.
      first_inliers: that the first pair needs.
      inliers: that a further image needs.
    """

    forward: float = 0.95
    angle: float = 16.0
    first_inliers: int = 100
    inliers: int = 30


_LIMITS = MapperLimits()


class ImageRecord(NamedTuple):
    """An image as COLMAP's database has it.

    Attributes:
      file: name within the folder of photographs; without spaces, which COLMAP's pair
        lists do not allow.
      width, height: px.
      focal: focal length in px from EXIF; None if unknown.
      camera: key of the camera; images with equal keys share their intrinsics.
    """

    file: str
    width: int
    height: int
    focal: float | None
    camera: str


def exif_camera(path: Path) -> tuple[str, float | None]:
    """Return the camera name and the focal length in px from EXIF.

    The focal length is side × (mm / sensor mm); the sensor size comes from EXIF or from
    COLMAP's table of cameras. A missing name is ""; a focal length that is missing or
    outside COLMAP's limits is None. COLMAP decodes what it reads, so it gets a small
    JPEG with the same EXIF in place of a photograph.
    """
    if path.suffix.lower() not in _WITH_EXIF:
        return _exif_camera(path)
    width, height = image_size(path)
    scale = max(1, max(width, height) / _SMALL)
    size = max(1, round(width / scale)), max(1, round(height / scale))
    exif = exif_of(path)
    if not exif:
        return "", None
    with TemporaryDirectory() as folder:
        small = Path(folder) / "small.jpg"
        small.write_bytes(blank_jpeg(size, exif))
        name, focal = _exif_camera(small)
    return name, None if focal is None else focal * scale


def _exif_camera(path: Path) -> tuple[str, float | None]:
    bitmap = colmap().Bitmap.read(str(path), False)
    if bitmap is None:
        return "", None
    # The name ends in the stored size, whose sides are swapped in a rotated photograph.
    name = re.sub(r"-\d+x\d+$", "", bitmap.exif_camera_model() or "")
    focal = bitmap.exif_focal_length() or 0.0
    side, limits = max(bitmap.width, bitmap.height), colmap().IncrementalMapperOptions()
    least, most = limits.min_focal_length_ratio, limits.max_focal_length_ratio
    return name, focal if least * side < focal < most * side else None


def extract_features(
    database: Path,
    folder: Path,
    masks: Path | None,
    records: Sequence[ImageRecord],
    progress: Progress,
    camera_model: str = "SIMPLE_RADIAL",
) -> None:
    """Write the cameras and SIFT features (CPU) of all images to the database.

    Images are registered in order beforehand: COLMAP's threads would number them in the
    order in which they finish, and results would not repeat.
    """
    pycolmap = colmap()
    pycolmap.Database.open(database).close()  # creates it
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model
    for key in dict.fromkeys(record.camera for record in records):
        names = [record.file for record in records if record.camera == key]
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, folder, mode, names, reader)
    _set_focal_lengths(database, records)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = usable_cores()  # COLMAP ignores container limits
    options.sift.max_num_features = MAX_FEATURES
    if masks is not None:
        reader.mask_path = masks

    def work(token):
        pycolmap.extract_features(
            database,
            folder,
            image_names=[record.file for record in records],
            camera_mode=pycolmap.CameraMode.PER_IMAGE,  # existing cameras are kept
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    def status():
        return f"features {count_rows(database, 'keypoints')}/{len(records)}"

    run_cancellable(work, status, progress)


def _set_focal_lengths(database: Path, records: Sequence[ImageRecord]) -> None:
    """Store EXIF focal lengths; the working files have no EXIF."""
    by_file = {record.file: record for record in records}
    with closing(colmap().Database.open(database)) as opened:
        for image in opened.read_all_images():
            record = by_file[image.name]
            if record.focal is None:
                continue
            camera = opened.read_camera(image.camera_id)
            params = list(camera.params)
            for index in camera.focal_length_idxs():
                params[index] = record.focal
            camera.params = params
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def match_features(
    database: Path, count: int, matcher: str, seed: int, progress: Progress
) -> None:
    """Match features between pairs of images and verify them geometrically.

    Args:
      count: number of images.
      matcher: "exhaustive" for all pairs, or "sequential" for each image's ten
        successors by name and those at distances that double.
    """
    pycolmap = colmap()
    exhaustive = matcher == "exhaustive"

    def work(token):
        step = pycolmap.match_exhaustive if exhaustive else pycolmap.match_sequential
        step(database, **_matching_options(seed), cancellation_token=token)

    def status():
        total = f"/{count * (count - 1) // 2}" if exhaustive else ""
        return f"matching pairs {count_rows(database, 'two_view_geometries')}{total}"

    run_cancellable(work, status, progress)


def _matching_options(seed: int, guided: bool = False) -> dict[str, Any]:
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


def map_incrementally(
    database: Path,
    folder: Path,
    models: Path,
    seed: int,
    progress: Progress,
    *,
    start: Path | None = None,
    limits: MapperLimits = _LIMITS,
) -> list[Any]:
    """Return the reconstructions of incremental mapping, most images first.

    Args:
      models: folder for COLMAP's output; created.
      start: folder of a model to extend; or None.
      limits: of pairs and images.
    """
    pycolmap = colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    # With several threads the order of summation, and so the last digits, would vary.
    options.num_threads = 1
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.min_model_size = _LEAST_IMAGES
    options.multiple_models = start is None
    options.max_model_overlap = _LEAST_IMAGES
    options.mapper.init_max_forward_motion = limits.forward
    options.mapper.init_min_tri_angle = limits.angle
    options.mapper.init_min_num_inliers = limits.first_inliers
    options.mapper.abs_pose_min_num_inliers = limits.inliers
    registered: list[None] = []  # one entry an image; callbacks have no arguments

    def work(token):
        return pycolmap.incremental_mapping(
            database,
            folder,
            models,
            options=options,
            input_path="" if start is None else start,
            initial_image_pair_callback=lambda: registered.extend([None, None]),
            next_image_callback=lambda: registered.append(None),
            cancellation_token=token,
        )

    models.mkdir()

    def status():
        return f"mapping: {len(registered)} images registered"

    found = run_cancellable(work, status, progress)
    for model in found.values():
        deregister_implausible(model, options.mapper)
    usable = [
        model
        for model in found.values()
        if model.num_reg_images() > 1 and not has_collapsed(model)
    ]
    return sorted(usable, key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def deregister_implausible(model: Any, limits: Any) -> None:
    """Remove images without points or with implausible intrinsics from a model.

    COLMAP does so before its last bundle adjustment, but not after.
    """
    for image in list(model.images.values()):
        implausible = image.camera.has_bogus_params(
            limits.min_focal_length_ratio,
            limits.max_focal_length_ratio,
            limits.max_extra_param,
        )
        if implausible or not image.num_points3D:
            model.deregister_frame(image.frame_id)
    model.tear_down()  # otherwise they stay in the model, without a pose


def has_collapsed(model: Any) -> bool:
    """Return whether most cameras of a model stand at one place, relative to the rest.

    Photographs that hardly move apart, or with hardly a match, give such a model.
    """
    centres = np.array([image.projection_center() for image in model.images.values()])
    if len(centres) < 4:
        return False
    apart = squareform(pdist(centres))
    nearest = np.median(np.min(apart + np.diag(np.full(len(centres), np.inf)), 1))
    return bool(nearest < _COLLAPSED * apart.max())


def rematch_guided(
    database: Path, files: set[str], pair_list: Path, seed: int, progress: Progress
) -> int:
    """Match the best pairs of unregistered images again, guided by their geometry.

    Guided matching finds up to ten times the matches at about five times the cost.

    Args:
      files: the unregistered images.
      pair_list: file to write the pairs to.

    Returns:
      The number of pairs.
    """
    pycolmap = colmap()
    with closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs, left = [], dict.fromkeys(files, _MAX_GUIDED_PAIRS_PER_IMAGE)
        for _count, ends in sorted(_verified_pairs(opened), reverse=True):
            ours = [names[end] for end in ends if left.get(names[end], 0)]
            if not ours or len(pairs) == _MAX_GUIDED_PAIRS:
                continue
            for name in ours:
                left[name] -= 1
            pairs.append(f"{names[ends[0]]} {names[ends[1]]}")
            opened.delete_two_view_geometry(*ends)
            opened.delete_matches(*ends)
    if not pairs:
        return 0
    pair_list.write_text("\n".join(pairs))
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = pair_list

    def work(token):
        pycolmap.match_image_pairs(
            database,
            pairing_options=options,
            **_matching_options(seed, guided=True),
            cancellation_token=token,
        )

    run_cancellable(work, lambda: f"matching pairs again: {len(pairs)}", progress)
    return len(pairs)


def _verified_pairs(opened: Any) -> list[tuple[int, tuple[int, int]]]:
    """Return (number of inliers, image ids) of every pair with inliers."""
    pairs = zip(*opened.read_two_view_geometry_num_inliers())
    return [(int(n), colmap().pair_id_to_image_pair(pair)) for pair, n in pairs if n]


def registration_failures(
    database: Path, names: dict[str, str], registered: set[str]
) -> dict[str, str]:
    """Return why images were not registered, judged by their features and matches.

    Args:
      names: file → name to show to users.
      registered: the files that were registered.

    Returns:
      File → reason, for each other file of ``names``.
    """
    with closing(colmap().Database.open(database)) as opened:
        files = {image.image_id: image.name for image in opened.read_all_images()}
        features = {
            name: opened.num_keypoints_for_image(key) for key, name in files.items()
        }
        matches: dict[str, dict[str, int]] = {}
        for count, ends in _verified_pairs(opened):
            first, second = (files[end] for end in ends)
            matches.setdefault(first, {})[second] = count
            matches.setdefault(second, {})[first] = count

    def reason(file: str) -> str:
        count, matched = features.get(file, 0), matches.get(file, {})
        if count < _FEW_FEATURES:
            return f"only {count} features found: blurred, dark or without texture"
        if not matched:
            return f"none of its {count} features matches another image consistently"
        inside = {other: n for other, n in matched.items() if other in registered}
        best = max(inside or matched, key=matched.__getitem__)
        why = "too few, or not consistent" if inside else "not registered either"
        return f"{matched[best]} matches at best, with {names[best]}: {why}"

    return {file: reason(file) for file in names if file not in registered}


def match_groups(database: Path) -> list[set[str]]:
    """Return the files of images that match one another, largest group first.

    Images are in one group if a chain of pairs with enough inliers connects them.
    """
    with closing(colmap().Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs = [ends for count, ends in _verified_pairs(opened) if count >= _GROUPED]
    order = {key: place for place, key in enumerate(names)}
    ends = np.array([[order[a], order[b]] for a, b in pairs], int).reshape(-1, 2)
    weights = np.ones(len(ends)), (ends[:, 0], ends[:, 1])
    graph = coo_array(weights, shape=(len(names), len(names)))
    _, labels = connected_components(graph, directed=False)
    groups: dict[int, set[str]] = {}
    for name, label in zip(names.values(), labels.tolist()):
        groups.setdefault(label, set()).add(name)
    return sorted((g for g in groups.values() if len(g) > 1), key=len, reverse=True)


def set_camera_model(database: Path, model: str) -> None:
    """Begin all cameras of a database anew with another model."""
    pycolmap = colmap()
    with closing(pycolmap.Database.open(database)) as opened:
        for before in opened.read_all_cameras():
            camera = pycolmap.Camera.create_from_model_name(
                before.camera_id, model, before.mean_focal_length(), *_size_of(before)
            )
            camera.has_prior_focal_length = before.has_prior_focal_length
            opened.update_camera(camera)


def _size_of(camera: Any) -> tuple[int, int]:
    return camera.width, camera.height


def match_summary(database: Path) -> tuple[int, int]:
    """Return the largest number of inliers of a pair, and the number of such pairs."""
    with closing(colmap().Database.open(database)) as opened:
        counts = [count for count, _ in _verified_pairs(opened)]
    return max(counts, default=0), len(counts)
