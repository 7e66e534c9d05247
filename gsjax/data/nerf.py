"""`transforms.json` as a scene: NeRF's synthetic scenes, instant-ngp and nerfstudio.

``applied_transform`` is not undone: as nerfstudio has it, it tells what was done to
poses and points already, so that both are in one frame as they stand.
"""

import os
import warnings
from os import PathLike
from pathlib import Path, PurePosixPath

import numpy as np

from gsjax.data.image_files import (
    check_factor,
    find_file,
    find_files,
    image_folder,
    inside,
    last_parts,
)
from gsjax.data.image_header import image_size
from gsjax.data.transforms_fields import (
    Frame,
    first_number,
    focal_lengths,
    model_of,
    pose_of,
    read_frames,
    shown,
    size_of,
    text_of,
    warn_of_scaled,
)
from gsjax.data.types import Dataset, Distortion, View, intrinsic_matrix
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud

_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
# The order of nerfstudio's distortion_params, which a frame may have.
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_UNUSED = "unused"
_SPLITS = {"transforms_train": "train", "transforms_test": "test"}


def find_transforms(folder: Path) -> list[Path]:
    """The camera lists of a folder: one for all, or NeRF's train and test lists.

    As with nerfstudio's names, validation views stand in for test views where there
    are none.
    """
    if (folder / "transforms.json").exists():
        return [folder / "transforms.json"]
    train, test, val = (
        folder / f"transforms_{s}.json" for s in ("train", "test", "val")
    )
    held_out = val if train.exists() and not test.exists() else test
    return [path for path in (train, held_out) if path.exists()]


def load_nerf(
    paths: list[Path],
    *,
    images: str | PathLike[str] | None = None,
    skip_missing: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
) -> Dataset:
    """The scene of camera lists in one folder; see `load_dataset`."""
    check_factor(factor)
    folder = root = paths[0].parent
    elsewhere = images is not None or (factor is not None and factor > 1)
    if elsewhere:
        # As nerfstudio: smaller copies lie in a folder of their own, images_4.
        root = image_folder(folder, images, factor, poses_only=poses_only)
    views: list[View] = []
    lists = [read_frames(path) for path in paths]
    for path, frames in zip(paths, lists):
        moved = images is not None or poses_only
        names = [_file_path(frame, moved) for frame in frames]
        files = find_files(
            *(path, root, names),
            skip_missing=skip_missing,
            elsewhere=elsewhere,
            factor=factor,
            poses_only=poses_only,
        )
        # A second list is of what is held out, transforms_val.json too.
        default = _SPLITS.get(path.stem) if path == paths[0] else "test"
        splits = _splits(path, frames, default)
        scaled: list[tuple[int, float]] = []
        for index, (frame, name) in enumerate(zip(frames, names)):
            if name not in files or splits[index] == _UNUSED:
                continue
            viewmat, scale = pose_of(frame)
            if scale != 1:
                scaled.append((index, scale))
            file = files[name]
            called = _name(file, folder, root)
            mask = None if poses_only else _mask(frame, folder)
            size = size_of(frame) or _size_of_file(frame, folder, root, file, factor)
            split = splits[index]
            views.append(_view(frame, file, called, viewmat, mask, size, split))
        warn_of_scaled(path, scaled)
    if not poses_only:
        _warn_of_dynamic_masks(views)
    points, colors = _points(lists[0][0], folder)
    source = paths[0] if len(paths) == 1 else folder
    return Dataset(source, "transforms", tuple(views), points, colors)


def _file_path(frame: Frame, moved: bool) -> str:
    """Where the photograph of a frame lies in the folder, by its list; of one that was
    ``moved`` to another, the end of it that does not lead out."""
    name = text_of(frame, "file_path")
    if not name:
        raise InputError(f"{frame.where}: file_path is {shown(name)}; text is wanted")
    if moved:
        return str(inside(frame.where, last_parts(name) or name))
    offer = ", or pass images=, the folder that it is in (--images)"
    return str(inside(frame.where, name, offer))


def _name(file: Path, folder: Path, root: Path) -> str:
    """Of a photograph: its path in the dataset, or in ``root`` if that is outside."""
    path, dataset = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    within = path.is_relative_to(dataset)
    return (path.relative_to(dataset) if within else file.relative_to(root)).as_posix()


def _splits(path: Path, frames: list[Frame], default: str | None) -> list[str | None]:
    """The split of each frame: by nerfstudio's lists of names, or that of the file.

    What is in two lists is held out; of what is in none, nothing is learnt where there
    is a list to train with.
    """
    listed = {key: _listed(path, frames, key) for key in ("val", "train", "test")}
    # Validation views stand in for test views where there are none, else are unused.
    held_out = listed["test"] or listed["val"]
    both = listed["train"] & held_out
    if both:
        warnings.warn(
            f"{path}: {len(both)} of {len(frames)} frames are listed to train and to "
            f"test with, {min(both)} first; they are held out",
            UserWarning,
            stacklevel=3,
        )
    named = dict.fromkeys(listed["val"], _UNUSED)
    named |= dict.fromkeys(listed["train"], "train")
    named |= dict.fromkeys(held_out, "test")
    names = [_spelt(str(text_of(frame, "file_path"))) for frame in frames]
    others = [name for name in names if name not in named]
    if listed["train"] and others:
        default = _UNUSED
        warnings.warn(
            f"{path}: {len(others)} of {len(names)} frames are in none of its lists, "
            f"{others[0]} first; they are left out, as nerfstudio leaves them",
            UserWarning,
            stacklevel=3,
        )
    return [named.get(name, default) for name in names]


def _listed(path: Path, frames: list[Frame], split: str) -> set[str]:
    """The frames that a list of nerfstudio's names, each of which is one."""
    names = frames[0].sources[1].get(f"{split}_filenames")
    if names is not None and not isinstance(names, list):
        raise InputError(f"{path}: {split}_filenames is {shown(names)}; a list")
    found = {_spelt(str(name)) for name in names or ()}
    strange = found - {_spelt(str(text_of(frame, "file_path"))) for frame in frames}
    if strange:
        raise InputError(
            f"{path}: {len(strange)} of {len(found)} names of {split}_filenames are of "
            f"no frame, {min(strange)!r} first; file_path of the frames are wanted"
        )
    return found


def _spelt(name: str) -> str:
    """A path as all ways to spell it come to."""
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def _view(
    frame: Frame,
    file: Path,
    name: str,
    viewmat: np.ndarray,
    mask: Path | None,
    size: tuple[int, int],
    split: str | None,
) -> View:
    lens = _lens(frame)
    width, height = size
    model = "fisheye" if lens is not None and lens.model == "fisheye" else "pinhole"
    fx, fy = focal_lengths(frame, width, height, model)
    cx, cy = first_number(frame, "cx"), first_number(frame, "cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return View(
        name=name,
        image=file,
        viewmat=viewmat,
        K=intrinsic_matrix(frame.where, (fx, fy), (cx, cy)),
        width=width,
        height=height,
        lens=lens,
        mask=mask,
        split=split,
    )


def _size_of_file(
    frame: Frame, folder: Path, root: Path, file: Path, factor: int | None
) -> tuple[int, int]:
    """That of the photograph which the camera is for, where the list does not say.

    An angle of view is one of any copy; what is in px is of the original.
    """
    if any(first_number(frame, key) is not None for key in _IN_PIXELS):
        original = find_file(folder, str(text_of(frame, "file_path")))
        if original is None and factor is not None and factor > 1:
            whole = root.with_name(root.name.removesuffix(f"_{factor}"))
            original = find_file(whole, file.relative_to(root).as_posix())
            if original is None:
                raise InputError(
                    f"{frame.where}: no image size: w and h are missing, and the "
                    f"photograph of which {file} is a smaller copy is not there; give "
                    "w and h in the file, of what fl_x, cx and cy are in px of"
                )
        file = original or file
    if not file.exists():  # where poses are all that is wanted
        raise InputError(
            f"{frame.where}: no image size: w and h are missing, and {file} is not "
            "there; give w and h in the file, or render from the file itself with a "
            "size (--cameras FILE --size WxH)"
        )
    return image_size(file)


def _mask(frame: Frame, folder: Path) -> Path | None:
    """The file that a frame names, if it does."""
    name = text_of(frame, "mask_path")
    if name is None:
        return None
    mask = folder / inside(frame.where, name)
    if not mask.is_file():
        raise InputError(
            f"{frame.where}: mask_path {shown(name)}: no such file in {folder}"
        )
    return mask


def _warn_of_dynamic_masks(views: list[View]) -> None:
    """Tell of instant-ngp's masks, which no list names: what is not black is left out
    there, the opposite of all others."""
    masks = [v.image.with_name(f"dynamic_mask_{v.image.stem}.png") for v in views]
    there = [mask for mask in masks if mask.is_file()]
    if there:
        warnings.warn(
            f"{there[0].parent}: {len(there)} masks of instant-ngp, {there[0].name} "
            "first, are not heeded; to leave out what they show, invert them, black "
            "for what is left out, and name them in the list by mask_path",
            UserWarning,
            stacklevel=3,
        )


def _lens(frame: Frame) -> Distortion | None:
    model = model_of(frame)
    if model not in (*_PERSPECTIVE, *_FISHEYE):
        raise InputError(
            f"{frame.where}: camera_model {shown(model)} is not supported; undistort "
            f"the photographs to a pinhole first; supported: "
            f"{', '.join((*_PERSPECTIVE, *_FISHEYE))}"
        )
    k1, k2, k3, k4, p1, p2 = _coefficients(frame)
    if model in _FISHEYE:
        if p1 or p2:
            raise InputError(
                f"{frame.where}: a fisheye has no p1, p2; found {p1}, {p2}"
            )
        return Distortion("fisheye", (k1, k2, k3, k4))
    if not any((k1, k2, k3, k4, p1, p2)):
        return None
    # As nerfstudio and instant-ngp, which read no rational denominator.
    higher = {key: first_number(frame, key) for key in ("k5", "k6")} | {"k4": k4}
    if any(higher.values()):
        raise InputError(
            f"{frame.where}: {', '.join(k for k, v in higher.items() if v)} of a lens "
            "that is no fisheye is not supported; undistort the photographs first"
        )
    return Distortion("radial_tangential", (k1, k2, p1, p2, k3))


def _coefficients(frame: Frame) -> list[float]:
    """k1 k2 k3 k4 p1 p2; those that are missing are 0."""
    given = frame.sources[0].get("distortion_params")
    if given is None:
        return [first_number(frame, key) or 0.0 for key in _COEFFICIENTS]
    if not isinstance(given, list) or len(given) != len(_COEFFICIENTS):
        raise InputError(
            f"{frame.where}: distortion_params is {shown(given)}; the numbers "
            f"{' '.join(_COEFFICIENTS)} are wanted"
        )
    named = Frame(frame.where, (dict(zip(_COEFFICIENTS, given)), {}))
    return [first_number(named, key) or 0.0 for key in _COEFFICIENTS]


def _points(frame: Frame, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] and colours of `ply_file_path`, if the file names one."""
    path = frame.sources[1].get("ply_file_path")
    if path is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not isinstance(path, str):
        raise InputError(f"{frame.where}: ply_file_path is {shown(path)}; text")
    cloud = folder / inside(f"{folder}: ply_file_path", path)
    if not cloud.is_file():
        raise InputError(
            f"{frame.where}: ply_file_path {shown(path)}: no such file in {folder}; "
            "put it there, or take ply_file_path off the list to go without points"
        )
    return read_point_cloud(cloud)
