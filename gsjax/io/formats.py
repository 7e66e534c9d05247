"""Load and save Gaussians in the format that the suffix of the file name selects."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, check_gaussians
from gsjax.io import gltf, ksplat, ply, sog, splat, spz
from gsjax.io.common import ANY_MODE, Format, warn
from gsjax.io.sog_files import META, scene_path

# A new format is one module and one entry here.
FORMATS = (
    *(ply.FORMAT, ply.PACKED_FORMAT, splat.FORMAT, spz.FORMAT, ksplat.FORMAT),
    *(sog.FORMAT, gltf.FORMAT),
)
DEFAULT_MODE = "default"  # of ordinary ellipsoids, as some programs record it


def load(
    path: str | PathLike[str], *, formats: Sequence[Format] = FORMATS
) -> Gaussians:
    """Read the Gaussians of a file; upper and lower case of the suffix are alike.

    Args:
      path: the file, or the folder of a SOG.
      formats: the known formats; of two with one suffix the last is used.
        ``(*FORMATS, mine)`` adds a format.

    Returns:
      Gaussians on all local devices, as `make_gaussians` places them.

    Raises:
      InputError: if the suffix is unknown, or the file is missing or invalid; see
        the reader of the format.
    """
    path, form = _chosen(path, formats, "load")
    assert form.load is not None
    return form.load(path)


def save(
    path: str | PathLike[str],
    gaussians: Gaussians,
    *,
    overwrite: bool = False,
    mode: str | None = None,
    formats: Sequence[Format] = FORMATS,
    **options,
) -> None:
    """Write the active Gaussians to a file.

    A .ply keeps every bit. The other formats round; see the reference page on formats.

    Args:
      path: the file to write; it appears complete or not at all.
      gaussians: the scene; inactive slots are left out.
      overwrite: replace an existing file.
      mode: render mode to record, see `render_mode`. A format that cannot record it
        causes a warning.
      formats: the known formats, as for `load`.
      **options: of the writer of the format, such as ``version`` of `write_spz`.

    Raises:
      InputError: if the suffix is unknown, the file exists and ``overwrite`` is
        not set, or it cannot be written.
    """
    path, form = _chosen(path, formats, "save")
    check_gaussians(gaussians)
    assert form.save is not None
    options["overwrite"] = overwrite
    if mode is not None and not {mode, ANY_MODE}.isdisjoint(form.modes):
        options["mode"] = mode
    elif mode is not None and mode != DEFAULT_MODE:
        warn(f"{path}: {_lost_mode(form, mode)}")
    form.save(path, gaussians, **options)


def render_mode(
    path: str | PathLike[str], *, formats: Sequence[Format] = FORMATS
) -> str | None:
    """Return how the Gaussians of a file are to be drawn, as the file records it.

    Returns:
      "2dgs" for surfels, "mip" for ellipsoids trained with antialiasing, another word
      of a PLY's "comment SplatRenderMode", or None if nothing is recorded.

    Raises:
      InputError: as `load`, from the header alone.
    """
    path, form = _chosen(path, formats, "load")
    return None if form.mode is None else form.mode(path)


def unrecorded_mode(path: Path, mode: str | None) -> str | None:
    """Return what is lost if a file of this name cannot record a render mode, or None.

    Raises:
      InputError: if the suffix is unknown.
    """
    form = _chosen(path, FORMATS, "save")[1]
    if mode in (None, DEFAULT_MODE) or not {mode, ANY_MODE}.isdisjoint(form.modes):
        return None
    return _lost_mode(form, mode)


def _lost_mode(form: Format, mode: str | None) -> str:
    lost = f"{form.name} files do not record the render mode {mode!r}"
    return f"{lost}; other programs draw the scene as ordinary ellipsoids"


def keeps_every_bit(path: Path) -> bool:
    """Return True for a plain PLY, which stores any value; other formats round."""
    return _chosen(path, FORMATS, "save")[1] is ply.FORMAT


def stored_bytes(path: Path) -> int:
    """Return the size of a scene on the disk, in bytes: of all files of a SOG.

    Raises:
      InputError: if the meta.json of a SOG cannot be read.
    """
    path = scene_path(path)
    return sog.scene_bytes(path) if path.name == META else path.stat().st_size


def _chosen(path, formats: Sequence[Format], action: str) -> tuple[Path, Format]:
    """Return the format whose suffix is the longest end of the file name."""
    if not isinstance(path, (str, PathLike)):
        got, remedy = type(path).__name__, "call load(path) or save(path, gaussians)"
        raise InputError(f"path: expected the name of a file, got {got}; {remedy}")
    path, known = Path(path), {s: f for f in formats for s in f.suffixes}
    path = scene_path(path) if action == "load" else path
    known = {s: f for s, f in known.items() if getattr(f, action)}
    fitting = [suffix for suffix in known if path.name.lower().endswith(suffix)]
    if not fitting:
        raise InputError(
            f"{path}: expected a suffix of {', '.join(sorted(known))}, got "
            f"{path.suffix!r}; convert the file, for example with SuperSplat, or pass "
            "formats=(*gsjax.io.formats.FORMATS, yours)"
        )
    return path, known[max(fitting, key=len)]
