"""Loading of datasets: photographs with known cameras, in any registered format."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.data.extent import cameras_coincide, least_extent, near_plane
from gsjax.data.readers import READERS
from gsjax.data.rebase import rebase
from gsjax.data.times import with_unit_times
from gsjax.data.types import Dataset, Reader, ReadOptions, unexpected
from gsjax.errors import InputError

# A camera is an outlier if its distance from the median position exceeds this multiple
# of the second largest distance (a heuristic). Beyond the second multiple, all other
# cameras coincide except for rounding, as on a tripod.
_OUTLIER_RATIO, _ROUNDING_RATIO = 1e6, 1e12
# At this distance float64 resolves a tenth of a unit, and products of two coordinates
# are finite in float32.
_MAX_DISTANCE = 1e15


def load_dataset(
    path: str | PathLike[str],
    *,
    images: str | PathLike[str] | None = None,
    skip_missing: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
    readers: Sequence[Reader] = READERS,
) -> Dataset:
    """Read the cameras, points and photograph names of a dataset.

    The first reader that detects its format reads the dataset. The default readers are,
    in this order:

    - a COLMAP model, .bin or .txt, in ``sparse/0``, ``sparse`` or the folder itself;
      photographs in ``images``, masks (0 excludes a pixel) in ``masks``;
    - ``transforms.json`` of nerfstudio or instant-ngp, or ``transforms_train.json`` and
      ``transforms_test.json`` (if absent, ``transforms_val.json``) of NeRF's synthetic
      scenes; another camera list is read if ``path`` is the .json file;
    - a COLMAP model in ``colmap/sparse/0``, as nerfstudio stores it;
    - ``poses_bounds.npy`` of LLFF; with a folder for each row in place of a photograph,
      they are fixed cameras, and the folders hold their frames;
    - ``dataset.json`` and ``metadata.json`` of Nerfies and HyperNeRF.

    Times of views are those of the files, of ``times.json``, or of the frame numbers of
    synchronised cameras; see `gsjax.data.times`.

    `load_photos` reads the photographs themselves. A dataset far from the origin is
    translated towards it, see `gsjax.data.rebase`.

    Args:
      path: folder of the dataset, or its .json or .npy file.
      images: folder of the photographs: a name in the dataset or a path. The default is
        ``images``; for a .json, the paths that it lists. In another folder, or for a
        smaller copy, leading folders of a listed name may be missing; a listed name
        that leaves the dataset is searched by its last parts in ``images`` only.
      skip_missing: omit listed photographs that do not exist, with a warning.
      factor: read the smaller copies in ``images_2``, ``images_4``, …
      poses_only: read cameras and points only. Photographs need not exist, masks are
        ignored, and a `View.image` may not be a file.
      readers: the formats, in order of precedence; append a `Reader` of your own with
        ``(*READERS, reader)``, `READERS` being in `gsjax.data.readers`.

    Returns:
      The dataset, with views sorted by name.

    Raises:
      InputError: if no format is detected, or a file is missing, truncated, damaged or
        unsupported. The message names the file, what was found in it and the remedy.
    """
    path, options = Path(path), ReadOptions(images, factor, skip_missing, poses_only)
    try:
        return finish_dataset(_reader_of(path, readers).load(path, options))
    except OSError as error:  # a name that is too long, for instance
        where = f"{str(error.filename or path)[:200]}: {error.strerror or error}"
        raise InputError(f"{where}; check the path and its permissions") from error


def is_dataset(path: Path, readers: Sequence[Reader] = READERS) -> bool:
    """Return whether `load_dataset` detects a dataset at an existing path."""
    return any(reader.detect(path) for reader in readers)


def _reader_of(path: Path, readers: Sequence[Reader]) -> Reader:
    if not path.exists():
        raise InputError(f"{path}: does not exist; pass the folder of a dataset")
    for reader in readers:
        if reader.detect(path):
            return reader
    if not path.is_dir():
        raise InputError(f"{path}: expected the folder of a dataset, a .json or a .npy")
    names = sorted(entry.name for entry in path.iterdir())[:12]
    raise InputError(
        f"{path}: expected sparse/0 of COLMAP, transforms.json, transforms_train.json, "
        "poses_bounds.npy or dataset.json, got "
        f"{', '.join(names) or 'an empty folder'}; for photographs without cameras run "
        "`gsjax sfm` first"
    )


def finish_dataset(dataset: Dataset) -> Dataset:
    """Return a dataset with sorted views, near planes and coordinates near the origin.

    Times are from 0 to 1, see `gsjax.data.times`.

    Raises:
      InputError: if there is no view, two have one name, a position is unusable, or
        only some views have a time.
    """
    views = sorted(dataset.views, key=lambda view: view.name)
    if not views:
        raise unexpected(dataset.source, "at least 1 view", "none", "add photographs")
    for before, after in pairwise(views):
        if before.name == after.name:
            where = f"{dataset.source}: the photograph {after.name!r}"
            raise InputError(f"{where} is listed more than once; remove all but one")
    centres = np.stack([view.centre for view in views])
    _check_positions(dataset, [view.name for view in views], centres)
    near = near_plane(centres, least_extent(dataset))
    views = tuple(replace(view, near=near) for view in views)
    dataset = rebase(with_unit_times(replace(dataset, views=views)))
    return _with_one_position(dataset) if cameras_coincide(centres) else dataset


def _with_one_position(dataset: Dataset) -> Dataset:
    """Return the dataset with all cameras where the first is: they differ by rounding.

    `rebase` may have made the differences the largest part of the coordinates.
    """
    centre, moved = dataset.views[0].centre, []
    for view in dataset.views:
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        moved.append(replace(view, viewmat=viewmat))
    return replace(dataset, views=tuple(moved))


def _check_positions(dataset: Dataset, names: list[str], centres: np.ndarray) -> None:
    """Raise on a camera too far away, or an outlier that alone would set the extent."""
    distances = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    worst = int(np.argmax(distances))
    others = float(np.max(np.delete(distances, worst), initial=0))
    if _OUTLIER_RATIO * others < distances[worst] < _ROUNDING_RATIO * others:
        raise InputError(
            f"{dataset.source}: the camera of {names[worst]!r} is "
            f"{distances[worst]:.3g} from the median position, all others within "
            f"{others:.3g}; remove the photograph, or estimate the cameras again"
        )
    worst = int(np.argmax(np.abs(centres).max(axis=1)))
    if np.abs(centres[worst]).max() > _MAX_DISTANCE:
        position = ", ".join(f"{value:.3g}" for value in centres[worst])
        where = f"{dataset.source}: the camera of {names[worst]!r} is at {position}"
        remedy = "from the origin; estimate the cameras again"
        raise InputError(f"{where}, expected at most {_MAX_DISTANCE:g} {remedy}")
