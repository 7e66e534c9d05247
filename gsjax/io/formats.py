"""Load and save Gaussians in the format that the suffix of the file name selects."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, check_gaussians
from gsjax.io import ply, splat, spz
from gsjax.io.common import Format

# A new format is one module and one entry here.
FORMATS = (ply.FORMAT, splat.FORMAT, spz.FORMAT)


def load(
    path: str | PathLike[str], *, formats: Sequence[Format] = FORMATS
) -> Gaussians:
    """Read the Gaussians of a file; upper and lower case of the suffix are alike.

    Args:
      path: the file.
      formats: the known formats; of two with one suffix the last is used.
        ``(*FORMATS, mine)`` adds a format.

    Returns:
      Gaussians on all local devices, as `make_gaussians` places them.

    Raises:
      InputError: if the suffix is unknown, or the file is missing or invalid; see
        `gsjax.io.ply.read_ply` and `gsjax.io.spz.read_spz`.
    """
    path = _checked_path(path)
    return _choose(path, {s: f.load for f in formats for s in f.suffixes})(path)


def save(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    formats: Sequence[Format] = FORMATS,
) -> None:
    """Write the active Gaussians to a file.

    A .ply keeps every bit. A .spz is a fifth as large, and .splat is what simple web
    viewers read; both round.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene; inactive slots are left out.
      overwrite: replace an existing file.
      formats: the known formats, as for `load`.

    Raises:
      InputError: if the suffix is unknown, the file exists and ``overwrite`` is
        not set, or it cannot be written.
    """
    path = _checked_path(path)
    check_gaussians(gaussians)
    write = _choose(path, {s: f.save for f in formats for s in f.suffixes})
    write(path, gaussians, overwrite=overwrite)


def _checked_path(path) -> Path:
    if not isinstance(path, (str, PathLike)):
        raise InputError(
            f"path: expected the name of a file, got {type(path).__name__}; call "
            "load(path) or save(path, gaussians)"
        )
    return Path(path)


def _choose(path: Path, by_suffix: dict):
    known = {suffix: one for suffix, one in by_suffix.items() if one is not None}
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InputError(
            f"{path}: expected a suffix of {', '.join(sorted(known))}, got "
            f"{path.suffix!r}; convert the file, for example with SuperSplat, or pass "
            "formats=(*gsjax.io.formats.FORMATS, yours)"
        )
    return known[suffix]
