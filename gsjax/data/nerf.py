"""Reader of `transforms.json`: NeRF's synthetic scenes, instant-ngp and nerfstudio.

nerfstudio's ``applied_transform`` is not undone: poses and points of the files are
already in one frame.
"""

import os
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from gsjax.data import image_files
from gsjax.data.image_header import image_size
from gsjax.data.transforms_fields import Frame, read_frames, shown, warn_of_scaled
from gsjax.data.transforms_lens import intrinsics_of_frame, lens_of_frame
from gsjax.data.types import (
    Dataset,
    Reader,
    ReadOptions,
    View,
    unexpected,
)
from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.point_cloud import read_point_cloud

_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_UNUSED = "unused"
_SPLITS = {"transforms_train": "train", "transforms_test": "test"}


def find_transforms(folder: Path) -> list[Path]:
    """Return the camera lists of a folder: one for all, or NeRF's train and test lists.

    Without test views, the validation views replace them.
    """
    if (folder / "transforms.json").exists():
        return [folder / "transforms.json"]
    names = (f"transforms_{split}.json" for split in ("train", "test", "val"))
    train, test, val = (folder / name for name in names)
    held_out = val if train.exists() and not test.exists() else test
    return [path for path in (train, held_out) if path.exists()]


def load_nerf(path: Path, options: ReadOptions | None = None) -> Dataset:
    """Read the dataset of a camera list, or of the lists in a folder.

    Raises:
      InputError: see `load_dataset`.
    """
    options = options or ReadOptions()
    image_files.check_factor(options.factor)
    paths = find_transforms(path) if path.is_dir() else [path]
    if not paths:
        raise unexpected(path, "a transforms.json", "none", "pass its folder")
    folder = root = paths[0].parent
    elsewhere = options.images is not None or (options.factor or 1) > 1
    if elsewhere:  # nerfstudio stores smaller copies in a folder of their own, images_4
        root = image_files.image_folder(folder, options)
    views: list[View] = []
    lists = [read_frames(path) for path in paths]
    for path, frames in zip(paths, lists):
        moved = options.images is not None or options.poses_only
        names = [_file_path(frame, moved) for frame in frames]
        files = image_files.find_files(path, root, names, options, elsewhere=elsewhere)
        # A second list, transforms_val.json too, is held out.
        default = _SPLITS.get(path.stem) if path == paths[0] else "test"
        splits = _splits(path, frames, default)
        scaled: list[tuple[int, float]] = []
        for index, (frame, name) in enumerate(zip(frames, names)):
            if name not in files or splits[index] == _UNUSED:
                continue
            viewmat, scale = frame.pose()
            if scale != 1:
                scaled.append((index, scale))
            file = files[name]
            size = frame.size() or _size_of_file(frame, folder, root, file, options)
            view = _view(frame, _name(file, folder, root), file, viewmat, size)
            mask = None if options.poses_only else _mask(frame, folder)
            views.append(replace(view, mask=mask, split=splits[index]))
        warn_of_scaled(path, scaled)
    if not options.poses_only:
        _warn_of_dynamic_masks(views)
    points, colors = _points(lists[0][0], folder)
    source = paths[0] if len(paths) == 1 else folder
    return Dataset(source, "transforms", tuple(views), points, colors)


def _file_path(frame: Frame, moved: bool) -> str:
    """Return the listed path, or its last parts for photographs that were moved."""
    name = frame.text("file_path")
    if not name:
        raise frame.unexpected("file_path", "text", name)
    return str(image_files.listed_path(frame.where, name, moved))


def _name(file: Path, folder: Path, root: Path) -> str:
    """Return the path of a file in the dataset, or in ``root`` if that is outside."""
    path, dataset = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    within = path.is_relative_to(dataset)
    return (path.relative_to(dataset) if within else file.relative_to(root)).as_posix()


def _splits(path: Path, frames: list[Frame], default: str | None) -> list[str | None]:
    """Return the split of each frame, from nerfstudio's lists of names or ``default``.

    A frame in both lists is held out; beside a training list, one in none is unused.
    """
    listed = {key: _listed(path, frames, key) for key in ("val", "train", "test")}
    # Validation views replace missing test views, else they are unused.
    held_out = listed["test"] or listed["val"]
    both = listed["train"] & held_out
    if both:
        warn(
            f"{path}: {len(both)} of {len(frames)} frames are in the training and the "
            f"test list, the first: {min(both)}; they are held out"
        )
    named = dict.fromkeys(listed["val"], _UNUSED)
    named |= dict.fromkeys(listed["train"], "train")
    named |= dict.fromkeys(held_out, "test")
    names = [_spelt(str(frame.text("file_path"))) for frame in frames]
    others = [name for name in names if name not in named]
    if listed["train"] and others:
        default = _UNUSED
        warn(
            f"{path}: {len(others)} of {len(names)} frames are in no list, the first: "
            f"{others[0]}; they are left out, as nerfstudio leaves them"
        )
    return [named.get(name, default) for name in names]


def _listed(path: Path, frames: list[Frame], split: str) -> set[str]:
    """Return the names in a list of nerfstudio; each must be that of a frame."""
    names = frames[0].sources[1].get(f"{split}_filenames")
    if names is not None and not isinstance(names, list):
        raise unexpected(f"{path}: {split}_filenames", "a list", shown(names))
    found = {_spelt(str(name)) for name in names or ()}
    strange = found - {_spelt(str(frame.text("file_path"))) for frame in frames}
    if strange:
        raise InputError(
            f"{path}: {split}_filenames: {len(strange)} of {len(found)} names are not "
            f"the file_path of a frame, the first: {min(strange)!r}; export it again"
        )
    return found


def _spelt(name: str) -> str:
    """Return the canonical spelling of a path."""
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def _view(
    frame: Frame, name: str, file: Path, viewmat: np.ndarray, size: tuple[int, int]
) -> View:
    lens = lens_of_frame(frame)
    K = intrinsics_of_frame(frame, size, lens)
    return View(name, file, viewmat, K, *size, lens, time=frame.number("time"))


def _size_of_file(
    frame: Frame, folder: Path, root: Path, file: Path, options: ReadOptions
) -> tuple[int, int]:
    """Return the size that a frame's intrinsics refer to, from the photograph's file.

    Intrinsics in px refer to the original; an angle of view holds for any copy.
    """
    where = f"{frame.where}: no image size: w and h are missing, and"
    if any(frame.number(key) is not None for key in _IN_PIXELS):
        original = image_files.find_file(folder, str(frame.text("file_path")))
        originals = image_files.original_folder(root, options)
        if original is None and originals is not None:
            name = file.relative_to(root).as_posix()
            original = image_files.find_file(originals, name)
            if original is None:
                raise InputError(
                    f"{where} the original of the smaller copy {file} does not exist; "
                    "give w and h in the file, the size that fl_x, cx and cy refer to"
                )
        file = original or file
    if not file.exists():  # with poses_only
        raise InputError(
            f"{where} {file} does not exist; give w and h in the file, or render from "
            "the file itself with a size (--cameras FILE --size WxH)"
        )
    return image_size(file)


def _mask(frame: Frame, folder: Path) -> Path | None:
    """Return the mask that a frame names, if any."""
    name = frame.text("mask_path")
    if name is None:
        return None
    return _file(frame, "mask_path", name, folder)


def _file(frame: Frame, key: str, name: str, folder: Path, remedy: str = "") -> Path:
    """Return the file that a key names, which must exist."""
    path = folder / image_files.inside(frame.where, name)
    if not path.is_file():
        raise InputError(
            f"{frame.where}: {key} {shown(name)}: no such file in {folder}; put it "
            f"there{remedy}"
        )
    return path


def _warn_of_dynamic_masks(views: list[View]) -> None:
    """Warn of instant-ngp's masks: no list names them, and black means kept."""
    masks = [v.image.with_name(f"dynamic_mask_{v.image.stem}.png") for v in views]
    there = [mask for mask in masks if mask.is_file()]
    if there:
        warn(
            f"{there[0].parent}: {len(there)} masks of instant-ngp are ignored, the "
            f"first: {there[0].name}; to use them, invert them (black is excluded) and "
            "name them in the list by mask_path"
        )


def _points(frame: Frame, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [M, 3] and colours of `ply_file_path`, if there is one."""
    path = frame.sources[1].get("ply_file_path")
    if path is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not isinstance(path, str):
        raise frame.unexpected("ply_file_path", "text", path)
    remedy = ", or remove ply_file_path from the list to go without points"
    return read_point_cloud(_file(frame, "ply_file_path", path, folder, remedy))


TRANSFORMS = Reader(
    "transforms.json",
    lambda p: bool(find_transforms(p)) if p.is_dir() else p.suffix.lower() == ".json",
    load_nerf,
)
