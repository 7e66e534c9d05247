"""Load and save Gaussians in the format that the suffix of the file name selects."""

from collections.abc import Callable, Sequence
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
    path, read = _chosen(path, formats, "load")
    return read(path)


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
    path, write = _chosen(path, formats, "save")
    check_gaussians(gaussians)
    write(path, gaussians, overwrite=overwrite)


def _chosen(path, formats: Sequence[Format], action: str) -> tuple[Path, Callable]:
    if not isinstance(path, (str, PathLike)):
        got, remedy = type(path).__name__, "call load(path) or save(path, gaussians)"
        raise InputError(f"path: expected the name of a file, got {got}; {remedy}")
    path, known = Path(path), {s: f for f in formats for s in f.suffixes}
    known = {s: getattr(f, action) for s, f in known.items() if getattr(f, action)}
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InputError(
            f"{path}: expected a suffix of {', '.join(sorted(known))}, got "
            f"{path.suffix!r}; convert the file, for example with SuperSplat, or pass "
            "formats=(*gsjax.io.formats.FORMATS, yours)"
        )
    return path, known[suffix]
