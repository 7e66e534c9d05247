"""Writer of datasets as COLMAP's binary files."""

import struct
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.data.colmap_binary import POINT
from gsjax.data.colmap_model import KIND_OF_NAME, MAX_NAME_BYTES
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError
from gsjax.runtime.files import make_folder, reject_existing, write_file


def write_colmap(
    folder: str | PathLike[str], dataset: Dataset, *, overwrite: bool = False
) -> None:
    """Write cameras.bin, images.bin and points3D.bin, in the coordinates of the files.

    Equal cameras are written once. Points have no track and an unknown error; ids count
    from 1 in the order of views and points. Photographs are not copied.

    Args:
      folder: folder of the model (``sparse/0`` of a dataset), created if missing.
      dataset: the dataset; its `origin` is added to the coordinates.
      overwrite: replace existing files.

    Raises:
      InputError: if a file exists and ``overwrite`` is not set, a file cannot be
        written, or COLMAP's files cannot hold a name or a lens.
    """
    folder = Path(folder)
    cameras, numbers = _cameras(dataset.views)
    content = {
        "cameras.bin": cameras,
        "images.bin": _images(dataset, numbers),
        "points3D.bin": _points(dataset),
    }
    reject_existing([folder / name for name in content], overwrite)
    make_folder(folder)
    for name, data in content.items():
        write_file(folder / name, data)


def _cameras(views: Sequence[View]) -> tuple[bytes, list[int]]:
    """Return the content of cameras.bin and the camera id of each view."""
    records: dict[bytes, int] = {}
    numbers = [records.setdefault(_camera(view), len(records) + 1) for view in views]
    rows = [struct.pack("<I", number) + row for row, number in records.items()]
    return struct.pack("<Q", len(rows)) + b"".join(rows), numbers


_KINDS = {
    "fisheye": "OPENCV_FISHEYE",
    "fov": "FOV",
    "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
    "rad_tan_thin_prism_fisheye": "RAD_TAN_THIN_PRISM_FISHEYE",
    "division": "DIVISION",
    "eucm": "EUCM",
    "equirectangular": "EQUIRECTANGULAR",
}


def _camera(view: View) -> bytes:
    """Return a record of cameras.bin without its id."""
    name, rest = "PINHOLE", ()
    if view.lens is not None:
        rest = view.lens.coefficients
        name = _KINDS.get(view.lens.model, "")
        if view.lens.model == "opencv" and len(rest) <= 8:
            name = "OPENCV" if len(rest) == 4 else "FULL_OPENCV"
        if not name:
            raise InputError(
                f"view {view.name!r}: COLMAP has no camera model for the lens "
                f"{view.lens.model} with {len(rest)} coefficients; undistort the "
                "photographs"
            )
    kind = KIND_OF_NAME[name]
    K = view.K
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *rest)
    if not kind.focals:
        params = (float(view.width), float(view.height))
    params += (0.0,) * (kind.size - len(params))
    head = struct.pack("<iQQ", kind.number, view.width, view.height)
    return head + struct.pack(f"<{kind.size}d", *params)


def _images(dataset: Dataset, numbers: Sequence[int]) -> bytes:
    from scipy.spatial.transform import Rotation

    parts = [struct.pack("<Q", len(dataset.views))]
    for index, (view, camera) in enumerate(zip(dataset.views, numbers), 1):
        name = view.name.encode()
        if not name or b"\0" in name or len(name) > MAX_NAME_BYTES:
            where, expected = f"view {view.name[:80]!r}", f"1 to {MAX_NAME_BYTES} bytes"
            remedy = "without NUL; rename the photograph"
            raise InputError(f"{where}: expected a name of {expected} {remedy}")
        rotation = view.viewmat[:3, :3]
        translation = view.viewmat[:3, 3] - rotation @ dataset.origin
        quat = Rotation.from_matrix(rotation).as_quat(canonical=True)[[3, 0, 1, 2]]
        pose = *quat, *translation
        parts.append(struct.pack("<I7dI", index, *pose, camera) + name + b"\0")
        parts.append(struct.pack("<Q", 0))  # no 2D points
    return b"".join(parts)


def _points(dataset: Dataset) -> bytes:
    table = np.zeros(len(dataset.points), POINT)
    table["id"] = np.arange(1, len(table) + 1)
    table["xyz"] = dataset.points + dataset.origin
    table["rgb"] = dataset.colors
    table["error"] = -1.0  # unknown
    return struct.pack("<Q", len(table)) + table.tobytes()
