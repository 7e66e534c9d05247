"""Gaussians from and to files, the format chosen by the suffix of the name."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.ply import read_ply, write_ply
from gsjax.io.splat import write_splat
from gsjax.io.spz import read_spz, write_spz


class Format(NamedTuple):
    """How one file format is read, ``read(path)``, or None, and written."""

    read: Callable[..., Gaussians] | None
    write: Callable[..., None]


# Suffix in lower case → format. A new format is one module and one line here.
FORMATS = {
    ".ply": Format(read_ply, write_ply),
    ".splat": Format(None, write_splat),
    ".spz": Format(read_spz, write_spz),
}


def load(path: str | PathLike[str]) -> Gaussians:
    """Gaussians of a file, in the format of its suffix (upper or lower case).

    Raises:
      InputError: if the suffix is unknown, or the file missing or not as it should
        be; see `gsjax.io.ply.read_ply` and `gsjax.io.spz.read_spz`.
    """
    path = Path(path)
    reading = {suffix: one.read for suffix, one in FORMATS.items() if one.read}
    return _of_suffix(path, reading)(path)


def save(
    path: str | PathLike[str], gaussians: Gaussians, *, overwrite: bool = False
) -> None:
    """Write the active Gaussians, in the format of the suffix of ``path``: .ply as they
    are; .spz, a fifth as large, and .splat rounded.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene; inactive slots are left out.
      overwrite: whether an existing file may be replaced.

    Raises:
      InputError: if the suffix is unknown, the file exists and ``overwrite`` is
        not set, or it cannot be written.
    """
    path = Path(path)
    writing = {suffix: one.write for suffix, one in FORMATS.items()}
    _of_suffix(path, writing)(path, gaussians, overwrite=overwrite)


def _of_suffix(path: Path, known: dict[str, Callable[..., Any]]) -> Callable[..., Any]:
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InputError(
            f"{path}: the suffix {path.suffix!r} is no known format of Gaussians; "
            f"known: {', '.join(sorted(known))}; convert it with the tool that made "
            "it, or with SuperSplat"
        )
    return known[suffix]
