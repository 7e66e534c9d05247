"""Where the photographs of a dataset lie: folders, names, and what is missing."""

import re
import warnings
from collections.abc import Iterable
from os import PathLike
from pathlib import Path, PurePosixPath

from gsjax.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_SHOWN = 5
_MAX_NAME, _MAX_PART = 1024, 251  # bytes; masks have ".png" appended


def image_folder(
    folder: Path, images: str | PathLike[str] | None, factor: int | None
) -> Path:
    """The folder of the photographs: ``images``, or ``images_4`` for factor 4.

    Args:
      folder: of the dataset.
      images: its name in the dataset, or a path of its own; None for "images".
      factor: by how much the photographs were made smaller; None or 1 for not.
    """
    check_factor(factor)
    suffix = f"_{factor}" if factor is not None and factor > 1 else ""
    found = folder / f"{Path('images' if images is None else images)}{suffix}"
    if found.is_dir():
        return found
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    remedy = "pass images=, the folder of the photographs (--images)"
    if suffix:
        remedy = "leave the factor out (photographs are scaled on load), or make it"
    raise InputError(
        f"{found}: no such folder; {folder} has the folders "
        f"{', '.join(names[:12]) or '(none)'}; {remedy}"
    )


def check_factor(factor: int | None) -> None:
    """Raise unless ``factor`` is None or a whole number of at least 1."""
    if factor is not None and not (isinstance(factor, int) and factor >= 1):
        raise InputError(f"factor {factor!r}: a whole number ≥ 1 is wanted")


def inside(where: str, name: str) -> PurePosixPath:
    """A relative path that stays in its folder; raises on one that would leave it."""
    path = PurePosixPath(name.replace("\\", "/"))
    absolute = path.is_absolute() or re.match("[A-Za-z]:", name)
    strange = "\0" in name or any("\ud800" <= letter <= "\udfff" for letter in name)
    if absolute or ".." in path.parts or strange or not path.parts:
        raise InputError(
            f"{where}: the name {name[:120]!r} is not that of a file within the "
            "dataset's folder; copy the file there and name it relative to the folder"
        )
    # Longer ones the system refuses, with an error of its own that names no remedy.
    sizes = [len(part.encode()) for part in path.parts]
    if max(sizes) > _MAX_PART or sum(sizes) > _MAX_NAME:
        raise InputError(
            f"{where}: the name {name[:120]!r}… has {sum(sizes)} bytes, {max(sizes)} "
            f"in one part; at most {_MAX_NAME} and {_MAX_PART} are wanted: rename the "
            "file"
        )
    return path


def find_files(
    source: Path, root: Path, names: Iterable[str], *, skip_missing: bool = False
) -> dict[str, Path]:
    """Files of photographs, by name; a name with no file is missing.

    A file of another suffix than its name stands in for it: smaller copies are often
    of another type, and NeRF's lists leave suffixes out.

    Args:
      source: the file that lists the names, for messages.
      root: the folder that they are relative to.
      names: as listed.
      skip_missing: leave out names without a file, with a warning.

    Raises:
      InputError: on missing files, unless ``skip_missing``; on all files missing; on
        a name that leads out of ``root``.
    """
    found: dict[str, Path] = {}
    missing: list[str] = []
    folders: dict[Path, dict[str, Path]] = {}
    for name in names:
        path = root / inside(str(source), name)
        if not path.is_file():
            stems = folders.setdefault(path.parent, _stems(path.parent))
            path = stems.get(path.name) or stems.get(path.stem)
        if path is None:
            missing.append(name)
        else:
            found[name] = path
    if missing:
        message = (
            f"{source}: {len(missing)} of {len(missing) + len(found)} photographs are "
            f"missing in {root}, the first: {', '.join(missing[:_SHOWN])}"
        )
        if not skip_missing or not found:
            raise InputError(
                f"{message}; put them there, or leave them out with skip_missing=True "
                "(--skip-missing)"
            )
        warnings.warn(f"{message}; left out", UserWarning, stacklevel=3)
    return found


def _stems(folder: Path) -> dict[str, Path]:
    """Photographs of a folder by their names without suffix."""
    files = [p for p in folder.iterdir() if p.is_file()] if folder.is_dir() else []
    rank = {suffix: index for index, suffix in enumerate(reversed(SUFFIXES))}
    files = [p for p in files if p.suffix.lower() in rank]
    files.sort(key=lambda p: (rank[p.suffix.lower()], p.name))
    return {p.stem: p for p in files}


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of a photograph, if there is one.

    Args:
      folder: of the masks; it need not exist.
      name: of the photograph: masks are called the same, or have ``.png`` appended
        (COLMAP) or in place of the suffix.
    """
    if not folder.is_dir():
        return None
    path = folder / inside(str(folder), name)
    candidates = (path, path.with_name(path.name + ".png"), path.with_suffix(".png"))
    return next((candidate for candidate in candidates if candidate.is_file()), None)
