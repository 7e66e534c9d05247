"""Paths of photographs and masks: folders, names, and reports of missing files."""

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path, PurePosixPath

from gsjax.data import heif
from gsjax.data.types import ReadOptions, unexpected
from gsjax.errors import InputError
from gsjax.io.common import warn

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"),
    *heif.SUFFIXES,
)
_SHOWN = 5
_MAX_NAME, _MAX_PART = 1024, 251  # bytes; masks have ".png" appended
_ENDING = re.compile(f"({'|'.join(map(re.escape, SUFFIXES))})+$", re.IGNORECASE)


def image_folder(folder: Path, options: ReadOptions) -> Path:
    """Return the folder of a dataset's photographs, ``images_4`` for factor 4.

    ``options.images`` is its name in the dataset or a path, by default "images"; with
    ``poses_only`` it need not exist.

    Raises:
      InputError: if there is no such folder; the message offers a factor that exists.
    """
    check_factor(options.factor)
    suffix = f"_{options.factor}" if (options.factor or 1) > 1 else ""
    original = folder / ("images" if options.images is None else options.images)
    found = Path(f"{original}{suffix}")
    if found.is_dir() or options.poses_only:
        return found
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    remedy = "pass images=, the folder of the photographs (--images)"
    if suffix:
        remedy = "leave the factor out (photographs are scaled on load), or make it"
    for least in _factors(original)[:1]:
        copies = f"pass factor={least} (--factor {least}), as {original.name}_{least}"
        remedy = f"{copies} is there; or {remedy}"
    raise InputError(
        f"{found}: no such folder; {folder} has the folders "
        f"{', '.join(names[:12]) or '(none)'}; {remedy}"
    )


def original_folder(root: Path, options: ReadOptions) -> Path | None:
    """Return the folder of the originals if ``root`` has smaller copies, else None."""
    if (options.factor or 1) <= 1:
        return None
    return root.with_name(root.name.removesuffix(f"_{options.factor}"))


def _factors(original: Path) -> list[int]:
    """Return the factors of the smaller copies beside a folder, such as its _2, _4."""
    beside = original.parent.iterdir() if original.parent.is_dir() else ()
    names = [entry.name for entry in beside if entry.is_dir()]
    form = re.escape(original.name) + "_([2-9]|[1-9][0-9]{1,3})"
    found = [re.fullmatch(form, name) for name in names]
    return sorted(int(match[1]) for match in found if match)


def check_factor(factor: int | None) -> None:
    """Raise unless ``factor`` is None or a whole number of at least 1."""
    if factor is not None and not (isinstance(factor, int) and factor >= 1):
        raise unexpected("factor", "a whole number ≥ 1", repr(factor), "pass 2, 4 or 8")


def inside(where: str, name: str, remedy: str = "") -> PurePosixPath:
    """Return a listed name as a relative path that stays in its folder.

    Messages begin with ``where``, and end with ``remedy`` beside copying the file.

    Raises:
      InputError: if the path is absolute, leaves the folder, or is not a usable name.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    absolute = path.is_absolute() or re.match("[A-Za-z]:", name)
    invalid = "\0" in name or any("\ud800" <= letter <= "\udfff" for letter in name)
    if absolute or ".." in path.parts or invalid or not path.parts:
        raise InputError(
            f"{where}: expected the name of a file within the dataset's folder, got "
            f"{name[:120]!r}; copy the file there and name it relative to the folder"
            f"{remedy}"
        )
    # The system would reject longer ones with an error that names no remedy.
    sizes = [len(part.encode()) for part in path.parts]
    if max(sizes) > _MAX_PART or sum(sizes) > _MAX_NAME:
        expected = f"a name of at most {_MAX_NAME} bytes and {_MAX_PART} a part"
        got = f"{name[:120]!r}… of {sum(sizes)} and {max(sizes)}"
        raise unexpected(where, expected, got, "rename the file")
    return path


def listed_path(where: str, name: str, moved: bool) -> PurePosixPath:
    """Return a photograph's listed name as a path in its folder, see `inside`.

    For photographs ``moved`` to another folder it is the part after the root and the
    last "..".
    """
    if moved:
        path = PurePosixPath(re.sub("^[A-Za-z]:", "/", name.replace("\\", "/")))
        parts = path.parts[1:] if path.is_absolute() else path.parts
        ups = [index for index, part in enumerate(parts) if part == ".."]
        name = "/".join(parts[ups[-1] + 1 :] if ups else parts) or name
    return inside(where, name, ", or pass images=, the folder that it is in (--images)")


def find_files(
    source: Path,
    root: Path,
    names: Iterable[str],
    options: ReadOptions,
    *,
    elsewhere: bool = False,
) -> dict[str, Path]:
    """Return the files of photographs by name, without the missing ones.

    A file with another suffix than its name is accepted, because smaller copies often
    have another type and NeRF's lists omit suffixes; so is another Unicode composition,
    as after a copy to or from macOS. Smaller copies of which none has a listed name, as
    in LLFF's scenes, are matched with the originals by their order, with a warning, if
    the two folders have equally many photographs.

    Args:
      source: the file that lists the names, for messages.
      root: folder that the names are relative to.
      names: names as listed.
      options: with ``skip_missing``, missing files only give a warning; with
        ``poses_only``, nothing is missing and a name without a file has the path where
        it would be; a ``factor`` above 1 says that ``root`` has smaller copies.
      elsewhere: ``root`` is another folder than the names refer to. Then the longest
        end of a name that exists there counts: of ``images/left/1.png`` the whole,
        then ``left/1.png``, then ``1.png``.

    Raises:
      InputError: if files are missing without ``skip_missing``, all are missing, two
        names refer to one file, or a name leaves ``root``.
    """
    names = list(names)
    found = _find(source, root, names, elsewhere)
    if options.poses_only:
        return {name: found.get(name, root / name) for name in names}
    original = original_folder(root, options)
    if not found and original is not None:
        there = _find(source, original, names, elsewhere)
        found = _match_by_order(original, root, there)
    owner: dict[Path, str] = {}
    for name, path in found.items():
        if owner.setdefault(path, name) != name:
            both = f"{owner[path]} and {name} are one photograph in {root}, {path.name}"
            remedy = "put the missing one there, or remove one from the list"
            raise InputError(f"{source}: {both}; {remedy}")
    missing = [name for name in names if name not in found]
    if missing:
        _report_missing(source, root, missing, len(found), options.skip_missing)
    return found


def _report_missing(
    source: Path, root: Path, missing: list[str], found: int, skip: bool
) -> None:
    """Warn of missing photographs if they may be skipped, else raise."""
    count = f"{len(missing)} of {len(missing) + found} photographs"
    message = f"{source}: {count} are missing in {root}"
    if found and skip:
        warn(f"{message} and left out: {', '.join(missing)}")
        return
    there = ", ".join(path.name for path in _photographs(root)[:_SHOWN])
    remedy = "leave them out with skip_missing=True (--skip-missing)"
    if not found:
        message += f" (it has {there or 'none'})"
        remedy = "pass images=, the folder that they are in (--images)"
    first = ", ".join(missing[:_SHOWN])
    raise InputError(f"{message}, the first: {first}; put them there, or {remedy}")


def _find(
    source: Path, root: Path, names: Sequence[str], elsewhere: bool
) -> dict[str, Path]:
    """Return the files of those ``names`` that exist in ``root``, see `find_files`."""
    found: dict[str, Path] = {}
    stems = cache(_stems)
    for name in names:
        parts = inside(str(source), name).parts
        ends = [parts[start:] for start in range(len(parts) if elsewhere else 1)]
        files = (_file_at(root.joinpath(*end), stems) for end in ends)
        path = next(filter(None, files), None)
        if path is not None:
            found[name] = path
    return found


def _match_by_order(
    original: Path, root: Path, found: dict[str, Path]
) -> dict[str, Path]:
    """Return the copies at the positions of ``found``; {} if there are not as many."""
    originals, copies = _photographs(original), _photographs(root)
    if len(originals) != len(copies):
        return {}
    copy_of = dict(zip(originals, copies))
    paired = {name: copy_of[path] for name, path in found.items() if path in copy_of}
    if paired:
        name = min(paired)
        warn(
            f"{root}: none of the {len(copies)} photographs has a name as in "
            f"{original}; they are matched in the order of their names: "
            f"{paired[name].name} is {name}"
        )
    return paired


def _photographs(folder: Path) -> list[Path]:
    """Return all photographs in a folder and its subfolders, sorted by name."""
    files = filter(is_photograph, folder.rglob("*"))
    return sorted(files, key=lambda path: path.relative_to(folder).as_posix())


def is_photograph(path: Path) -> bool:
    """Return whether a file name is that of a photograph and not hidden.

    macOS puts a hidden file beside each one that it copies to a foreign disk.
    """
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def find_file(root: Path, name: str) -> Path | None:
    """Return the photograph of a listed name if it exists within ``root``."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts:
        return None
    return _file_at(root / path, _stems)


def _file_at(path: Path, stems: Callable[[Path], dict[str, Path]]) -> Path | None:
    """Return the file at a path, or the photograph of that name but for its suffix."""
    if path.is_file():
        return path
    names = _composed(path.name), _composed(path.stem)
    return next(filter(None, map(stems(path.parent).get, names)), None)


def _stems(folder: Path) -> dict[str, Path]:
    """Return the photographs of a folder by composed name, with and without suffix."""
    files = [p for p in folder.iterdir() if p.is_file()] if folder.is_dir() else []
    rank = {suffix: index for index, suffix in enumerate(reversed(SUFFIXES))}
    files = [p for p in files if p.suffix.lower() in rank]
    files.sort(key=lambda p: (rank[p.suffix.lower()], p.name))
    by_name = {_composed(p.name): p for p in files}
    return {_composed(p.stem): p for p in files} | by_name


def _composed(name: str) -> str:
    """Return a name in Unicode's form C; macOS stores accents as separate letters."""
    return unicodedata.normalize("NFC", name)


def short_names(names: Sequence[str]) -> list[str]:
    """Return names without suffixes, or unchanged if two of them would become equal."""
    short = [PurePosixPath(name).with_suffix("").as_posix() for name in names]
    unique = len({name.casefold() for name in short}) == len(short)
    return short if unique else list(names)


def natural_order(name: str) -> tuple[list[str | int], str]:
    """Return a sort key that orders numbers by value: IMG_2 before IMG_10."""
    # Words have even indices and numbers odd ones, so equal types are compared.
    parts = re.split("([0-9]+)", name)
    return [int(p) if k % 2 else p for k, p in enumerate(parts)], name


def check_name(path: Path) -> None:
    """Raise `InputError` unless a file name can be encoded as UTF-8."""
    try:
        path.name.encode()
    except UnicodeEncodeError as error:
        raise InputError(
            f"{path.parent}: the name {path.name!r} is not UTF-8; rename the file"
        ) from error


def find_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the masks of photographs by name, as `find_mask` finds them.

    Warns of photographs without one, unless the folder does not exist.
    """
    if not folder.is_dir():
        return {}
    listing = cache(files_by_lowered_suffix)
    masks = {name: find_mask(folder, name, listing) for name in names}
    found = {name: mask for name, mask in masks.items() if mask is not None}
    lacking = [name for name in masks if name not in found]
    if lacking:
        warn(
            f"{folder}: {len(lacking)} of {len(masks)} photographs have no mask, the "
            f"first: {', '.join(lacking[:_SHOWN])}; all of their pixels are used"
        )
    return found


def _lowered(name: str) -> str:
    """Return a composed name with the suffixes of photographs in lower case."""
    return _ENDING.sub(lambda ending: ending[0].lower(), _composed(name))


def files_by_lowered_suffix(folder: Path) -> dict[str, Path]:
    """Return the entries of a folder, which need not exist, by `_lowered` name."""
    entries = sorted(folder.iterdir()) if folder.is_dir() else ()
    return {_lowered(entry.name): entry for entry in entries}


def find_mask(
    folder: Path,
    name: str,
    listing: Callable[[Path], dict[str, Path]] = files_by_lowered_suffix,
) -> Path | None:
    """Return the mask of a photograph in a folder, which need not exist, or None.

    A mask has the photograph's name, or ``.png`` appended (COLMAP) or as its suffix;
    case of suffixes and Unicode composition may differ. ``listing`` returns the entries
    of a folder by `_lowered` name.
    """
    path = folder / inside(str(folder), name)
    names = (path.name, path.name + ".png", path.stem + ".png")
    exact = next((p for p in map(path.with_name, names) if p.is_file()), None)
    if exact is not None:
        return exact
    files = listing(path.parent)
    loose = (files.get(_lowered(mask)) for mask in names)
    return next((mask for mask in loose if mask and mask.is_file()), None)
