"""Gaussians from and to files, the format chosen by the suffix of the name."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.ply import read_ply, write_ply


class Format(NamedTuple):
    """How one file format is read, ``read(path)``, and written."""

    read: Callable[..., Gaussians]
    write: Callable[..., None]


# Suffix in lower case → format. A new format is one module and one line here.
FORMATS = {".ply": Format(read_ply, write_ply)}


def load(path: str | PathLike[str]) -> Gaussians:
    """Gaussians of a file, in the format of its suffix (upper or lower case).

    Raises:
      InputError: if the suffix is unknown, or the file missing or not as it should
        be; see `gsjax.io.ply.read_ply`.
    """
    return _format_of(Path(path)).read(path)


def save(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians, in the format of the suffix of ``path``.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene; inactive slots are left out.
      overwrite: whether an existing file may be replaced.

    Raises:
      InputError: if the suffix is unknown, the file exists and ``overwrite`` is
        not set, or it cannot be written.
    """
    _format_of(Path(path)).write(path, gaussians, overwrite=overwrite)


def _format_of(path: Path) -> Format:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(
            f"{path}: the suffix {path.suffix!r} is no known format of Gaussians; "
            f"known: {', '.join(sorted(FORMATS))}; convert it with the tool that made "
            "it, or with SuperSplat"
        )
    return FORMATS[suffix]
