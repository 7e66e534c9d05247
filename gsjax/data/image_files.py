"""Where the photographs of a dataset lie: folders, names, and what is missing."""

import re
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from os import PathLike
from pathlib import Path, PurePosixPath

from gsjax.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_SHOWN = 5
_MAX_NAME, _MAX_PART = 1024, 251  # bytes; masks have ".png" appended
_ENDING = re.compile(f"({'|'.join(map(re.escape, SUFFIXES))})+$", re.IGNORECASE)


def image_folder(
    folder: Path,
    images: str | PathLike[str] | None,
    factor: int | None,
    *,
    poses_only: bool = False,
) -> Path:
    """The folder of the photographs: ``images``, or ``images_4`` for factor 4.

    Args:
      folder: of the dataset.
      images: its name in the dataset, or a path of its own; None for "images".
      factor: by how much the photographs were made smaller; None or 1 for not.
      poses_only: the folder need not be there.

    Raises:
      InputError: if there is no such folder; the message offers a factor that is there.
    """
    check_factor(factor)
    suffix = f"_{factor}" if factor is not None and factor > 1 else ""
    whole = folder / ("images" if images is None else images)
    found = Path(f"{whole}{suffix}")
    if found.is_dir() or poses_only:
        return found
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    remedy = "pass images=, the folder of the photographs (--images)"
    if suffix:
        remedy = "leave the factor out (photographs are scaled on load), or make it"
    factors = _factors(whole)
    if factors:
        copies, least = f"{whole.name}_{factors[0]}", factors[0]
        remedy = (
            f"pass factor={least} (--factor {least}), as {copies} is there; or {remedy}"
        )
    raise InputError(
        f"{found}: no such folder; {folder} has the folders "
        f"{', '.join(names[:12]) or '(none)'}; {remedy}"
    )


def _factors(whole: Path) -> list[int]:
    """By how much the copies beside a folder of photographs are smaller: its _2, _4."""
    beside = whole.parent.iterdir() if whole.parent.is_dir() else ()
    names = [entry.name for entry in beside if entry.is_dir()]
    form = re.escape(whole.name) + "_([2-9]|[1-9][0-9]{1,3})"
    found = [re.fullmatch(form, name) for name in names]
    return sorted(int(match[1]) for match in found if match)


def check_factor(factor: int | None) -> None:
    """Raise unless ``factor`` is None or a whole number of at least 1."""
    if factor is not None and not (isinstance(factor, int) and factor >= 1):
        raise InputError(f"factor {factor!r}: a whole number ≥ 1 is wanted")


def inside(where: str, name: str, remedy: str = "") -> PurePosixPath:
    """A relative path that stays in its folder; raises on one that would leave it, and
    offers a ``remedy`` besides copying the file."""
    path = PurePosixPath(name.replace("\\", "/"))
    absolute = path.is_absolute() or re.match("[A-Za-z]:", name)
    strange = "\0" in name or any("\ud800" <= letter <= "\udfff" for letter in name)
    if absolute or ".." in path.parts or strange or not path.parts:
        raise InputError(
            f"{where}: the name {name[:120]!r} is not that of a file within the "
            "dataset's folder; copy the file there and name it relative to the folder"
            f"{remedy}"
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


def last_parts(name: str) -> str:
    """What follows the root or the last ".." of a path, for another folder than its."""
    path = PurePosixPath(re.sub("^[A-Za-z]:", "/", name.replace("\\", "/")))
    parts = path.parts[1:] if path.is_absolute() else path.parts
    ups = [index for index, part in enumerate(parts) if part == ".."]
    return "/".join(parts[ups[-1] + 1 :] if ups else parts)


def find_files(
    source: Path,
    root: Path,
    names: Iterable[str],
    *,
    skip_missing: bool = False,
    elsewhere: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
) -> dict[str, Path]:
    """Files of photographs, by name; a name with no file is missing.

    A file of another suffix than its name stands in for it: smaller copies are often
    of another type, and NeRF's lists leave suffixes out; and one whose letters are
    composed otherwise, as after a copy to or from macOS. Copies of which none is called
    like its original, as in the scenes of LLFF, go with the originals in the order of
    their names, if they are as many; a warning says so.

    Args:
      source: the file that lists the names, for messages.
      root: the folder that they are relative to.
      names: as listed.
      skip_missing: leave out names without a file, with a warning.
      elsewhere: ``root`` is not the folder that the names are of. Then the longest end
        of a name that has a file there counts: of ``images/left/1.png`` all, then
        ``left/1.png``, then ``1.png``.
      factor: above 1, ``root`` is ``images_4``, of the copies of ``images``.
      poses_only: nothing is missing; a name without a file has the path of one.

    Raises:
      InputError: on missing files, unless ``skip_missing``; on all files missing; on
        two names of one file; on a name that leads out of ``root``.
    """
    names = list(names)
    found = _called(source, root, names, elsewhere)
    if poses_only:
        return {name: found.get(name, root / name) for name in names}
    if not found and factor is not None and factor > 1:
        whole = root.with_name(root.name.removesuffix(f"_{factor}"))
        found = _in_order(whole, root, _called(source, whole, names, elsewhere))
    missing = [name for name in names if name not in found]
    owner: dict[Path, str] = {}
    for name, path in found.items():
        if owner.setdefault(path, name) != name:
            raise InputError(
                f"{source}: {owner[path]} and {name} are one photograph in {root}, "
                f"{path.name}; put there what is missing, or take one off the list"
            )
    if missing:
        message = (
            f"{source}: {len(missing)} of {len(missing) + len(found)} photographs are "
            f"missing in {root}"
        )
        if not found:
            there = ", ".join(path.name for path in _photographs(root)[:_SHOWN])
            raise InputError(
                f"{message}, the first: {', '.join(missing[:_SHOWN])}, where there are "
                f"{there or 'none'}; put them there, or pass images=, the folder that "
                "they are in (--images)"
            )
        if not skip_missing:
            raise InputError(
                f"{message}, the first: {', '.join(missing[:_SHOWN])}; put them there, "
                "or leave them out with skip_missing=True (--skip-missing)"
            )
        left = f"{message} and left out: {', '.join(missing)}"
        warnings.warn(left, UserWarning, stacklevel=3)
    return found


def _called(
    source: Path, root: Path, names: Sequence[str], elsewhere: bool
) -> dict[str, Path]:
    """Those of ``names`` that have a file in ``root``, see `find_files`."""
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


def _in_order(whole: Path, root: Path, found: dict[str, Path]) -> dict[str, Path]:
    """For files ``found`` in ``whole`` the copies in ``root`` of the same place in the
    order of all; none where the photographs of the two are not as many."""
    originals, copies = _photographs(whole), _photographs(root)
    if len(originals) != len(copies):
        return {}
    copy_of = dict(zip(originals, copies))
    paired = {name: copy_of[path] for name, path in found.items() if path in copy_of}
    if paired:
        name = min(paired)
        warnings.warn(
            f"{root}: none of the {len(copies)} photographs is called as in {whole}; "
            f"they are taken in the order of their names: {paired[name].name} is "
            f"{name}",
            UserWarning,
            stacklevel=4,
        )
    return paired


def _photographs(folder: Path) -> list[Path]:
    """All photographs in a folder and in those within, in the order of their names."""
    files = [p for p in folder.rglob("*") if is_photograph(p)]
    return sorted(files, key=lambda path: path.relative_to(folder).as_posix())


def is_photograph(path: Path) -> bool:
    """By its name; what is hidden, as macOS has it beside each file, is none."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def find_file(root: Path, name: str) -> Path | None:
    """The photograph ``name`` of a list in ``root``, if it is there, see
    `find_files`; what leads out of it is not."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts:
        return None
    return _file_at(root / path, _stems)


def _file_at(path: Path, stems: Callable[[Path], dict[str, Path]]) -> Path | None:
    """The file there, or the photograph that is called so but for its suffix."""
    if path.is_file():
        return path
    names = _composed(path.name), _composed(path.stem)
    return next(filter(None, map(stems(path.parent).get, names)), None)


def _stems(folder: Path) -> dict[str, Path]:
    """Photographs of a folder by their names, `_composed`, whole and without suffix."""
    files = [p for p in folder.iterdir() if p.is_file()] if folder.is_dir() else []
    rank = {suffix: index for index, suffix in enumerate(reversed(SUFFIXES))}
    files = [p for p in files if p.suffix.lower() in rank]
    files.sort(key=lambda p: (rank[p.suffix.lower()], p.name))
    whole = {_composed(p.name): p for p in files}
    return {_composed(p.stem): p for p in files} | whole


def _composed(name: str) -> str:
    """A name with its letters and accents composed, which macOS has apart: in Unicode's
    form C."""
    return unicodedata.normalize("NFC", name)


def short_names(names: Sequence[str]) -> list[str]:
    """Of photographs: without suffixes, unless two of them then had one name."""
    short = [PurePosixPath(name).with_suffix("").as_posix() for name in names]
    clear = len({name.casefold() for name in short}) == len(short)
    return short if clear else list(names)


def natural_order(name: str) -> tuple[list[str | int], str]:
    """By which to sort names as people count: IMG_2 before IMG_10."""
    # Words stand at even places and numbers at odd ones, so that like meets like.
    parts = re.split("([0-9]+)", name)
    return [int(p) if k % 2 else p for k, p in enumerate(parts)], name


def check_name(path: Path) -> None:
    """See that the name of a file is UTF-8, in which datasets hold it.

    Raises:
      InputError: if it is not.
    """
    try:
        path.name.encode()
    except UnicodeEncodeError as error:
        raise InputError(
            f"{path.parent}: the name of {path.name!r} is not UTF-8; rename the file"
        ) from error


def find_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The masks of photographs, by name, as `find_mask` knows them.

    Photographs without one are warned of, unless there is no such folder.
    """
    if not folder.is_dir():
        return {}
    listing = cache(by_suffix_of_either_case)
    masks = {name: find_mask(folder, name, listing) for name in names}
    found = {name: mask for name, mask in masks.items() if mask is not None}
    lacking = [name for name in masks if name not in found]
    if lacking:
        warnings.warn(
            f"{folder}: {len(lacking)} of {len(masks)} photographs have no mask there, "
            f"the first: {', '.join(lacking[:_SHOWN])}; nothing of them is left out (a "
            f"mask would be {PurePosixPath(lacking[0]).with_suffix('.png')})",
            UserWarning,
            stacklevel=3,
        )
    return found


def _lowered(name: str) -> str:
    """A name, `_composed`, with the suffixes of photographs that it ends with in lower
    case."""
    return _ENDING.sub(lambda ending: ending[0].lower(), _composed(name))


def by_suffix_of_either_case(folder: Path) -> dict[str, Path]:
    """What is in a folder, which need not exist, by `_lowered` names."""
    entries = sorted(folder.iterdir()) if folder.is_dir() else ()
    return {_lowered(entry.name): entry for entry in entries}


def find_mask(
    folder: Path,
    name: str,
    listing: Callable[[Path], dict[str, Path]] = by_suffix_of_either_case,
) -> Path | None:
    """The mask of a photograph, if there is one.

    Args:
      folder: of the masks; it need not exist.
      name: of the photograph: masks are called the same, or have ``.png`` appended
        (COLMAP) or in place of the suffix. Suffixes may be of either case, and letters
        composed or not.
      listing: what is in a folder, by `_lowered` names.
    """
    path = folder / inside(str(folder), name)
    called = (path.name, path.name + ".png", path.stem + ".png")
    exact = [path.with_name(mask) for mask in called]
    found = next((mask for mask in exact if mask.is_file()), None)
    if found is None:
        files = listing(path.parent)
        loose = [files[_lowered(mask)] for mask in called if _lowered(mask) in files]
        found = next((mask for mask in loose if mask.is_file()), None)
    return found
