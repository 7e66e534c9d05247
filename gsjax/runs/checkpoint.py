"""Checkpoints: the whole state of a run in one file, written at once or not at all.

An .npz holds every array of the state under its path in the pytree, each with a
checksum (that of the zip format), and a JSON text beside them. The two latest are
kept, so that a file that was damaged later costs one interval, not the run.
"""

import io
import json
import math
import re
import struct
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.io.npy import read_npy
from gsjax.runtime.files import make_folder, opened, write_file
from gsjax.train.state import TrainState

_KEEP = 2
_FORMAT = 1
_META = "meta.json"
_REMEDY = "remove it to go on from the one before, or train anew"
# What zipfile raises of damaged archives.
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError),
    *(EOFError, KeyError, OverflowError, struct.error),
)


class Checkpoint(NamedTuple):
    """A file as read.

    Attributes:
      path: of the file.
      step: at which it was written.
      arrays: by path in the state.
      meta: what was saved with it: ``capacity``, ``pair_capacity``, …
    """

    path: Path
    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]


def _named_leaves(state: TrainState) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def _is_key(leaf) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def save_checkpoint(folder: Path, state: TrainState, meta: dict[str, Any]) -> Path:
    """Write the state; older files than the latest two are removed after that.

    Args:
      folder: created if missing.
      state: of the run.
      meta: JSON values to keep with it: ``pair_capacity``, ``seconds`` of training, and
        the number of ``devices``, which may be missing.

    Raises:
      InputError: if it cannot be written; the checkpoints that were there still are.
    """
    make_folder(folder)
    leaves = _named_leaves(state)
    arrays = {
        name: np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
        for name, leaf in leaves.items()
    }
    step = int(state.step)
    text = {**meta, "format": _FORMAT, "step": step}
    text["capacity"], text["arrays"] = state.gaussians.capacity, sorted(arrays)
    encoded = np.frombuffer(json.dumps(text).encode(), np.uint8)
    buffer = io.BytesIO()
    if any(array.dtype.hasobject for array in arrays.values()):
        # NumPy below 2.2 cannot be told to refuse them itself.
        raise TypeError("a state is of numbers alone; objects are in this one")
    np.savez(buffer, **{_META: encoded, **arrays})  # pyright: ignore
    path = folder / f"step_{step:09d}.npz"
    # Given up at once where writing fails: a view that lives on with the error keeps
    # the buffer from being freed.
    with buffer.getbuffer() as data:
        write_file(path, data, durable=True)
    # Later ones, which a run that was taken up again could not read, do not count.
    upto = [old for old in _files(folder) if old.name <= path.name]
    for old in upto[:-_KEEP]:
        old.unlink(missing_ok=True)
    return path


def latest_step(folder: Path) -> int | None:
    """Of the last checkpoint in the folder, by its name; None where there is none."""
    names = _files(folder)
    return int(names[-1].stem.removeprefix("step_")) if names else None


def _files(folder: Path) -> list[Path]:
    names = sorted(folder.glob("step_*.npz"))
    return [path for path in names if re.fullmatch(r"step_\d{9}\.npz", path.name)]


def load_latest(folder: Path, steps: int | None = None) -> Checkpoint:
    """The latest checkpoint that can be used; a warning names those that cannot.

    Args:
      folder: of the checkpoints.
      steps: of the whole run; see `load_checkpoint`.

    Raises:
      InputError: if there is none.
    """
    failed = []
    for path in reversed(_files(folder)):
        try:
            found = load_checkpoint(path, steps)
        except InputError as error:
            failed.append(str(error))
            continue
        for message in failed:
            warnings.warn(f"{message}; going on from {path.name}", stacklevel=2)
        return found
    told = f" ({'; '.join(failed)})" if failed else ""
    raise InputError(f"{folder}: no checkpoint to go on from{told}; train anew")


def load_checkpoint(path: Path, steps: int | None = None) -> Checkpoint:
    """One file.

    Args:
      path: of the file.
      steps: of the whole run, beyond which it cannot have come; None for any.

    Raises:
      InputError: if it is damaged, cut short or no checkpoint, or holds values that no
        run can have come to.
    """
    where = f"{path}: no readable checkpoint"
    arrays = {
        name.removesuffix(".npy"): read_npy(f"{path}: {name}", data)
        for name, data in _entries(path)
    }
    if _META not in arrays:
        raise InputError(f"{where}: {_META} is not in it; {_REMEDY}")
    text = arrays.pop(_META).tobytes()
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: {_META}: {str(error)[:80]}; {_REMEDY}") from error
    wanted = {
        "format": lambda value: value == _FORMAT,
        "step": lambda value: type(value) is int and value >= 0,
        "capacity": lambda value: type(value) is int and value in _lengths(arrays),
        "pair_capacity": lambda value: type(value) is int and 0 <= value < 2**30,
        "seconds": lambda value: type(value) in (int, float) and 0 <= value < math.inf,
        "arrays": lambda value: value == sorted(arrays),
        "devices": lambda value: type(value) is int and value >= 1,
    }
    meta = meta if isinstance(meta, dict) else {}
    if "devices" not in meta:  # an old one
        del wanted["devices"]
    for key, good in wanted.items():
        if not good(meta.get(key)):
            found = repr(meta.get(key, "missing"))[:80]
            told = f"; {_FORMAT} is wanted" if key == "format" else ""
            raise InputError(f"{where}: {_META}: {key} {found}{told}; {_REMEDY}")
    fault = _step_fault(path, arrays, meta["step"], steps) or _fault(arrays)
    if fault is not None:
        raise InputError(f"{path}: damaged checkpoint: {fault}; {_REMEDY}")
    return Checkpoint(path, meta["step"], arrays, meta)


def _step_fault(
    path: Path, arrays: dict[str, np.ndarray], step: int, steps: int | None
) -> str | None:
    """What contradicts the step that a checkpoint says it is of."""
    named = re.fullmatch(r"step_(\d{9})\.npz", path.name)
    if named is not None and int(named[1]) != step:
        return f"{_META} says step {step}, and its name another"
    if steps is not None and step > steps:
        return f"{_META} says step {step} of a run of {steps} (config.json)"
    told = arrays.get(".step", np.int32(step)).tolist()
    if told != step:
        return f".step is {str(told)[:40]}, and {_META} says {step}"
    for name in (".moments.count", ".refinement_moments.count"):
        # Steps without a gradient are not counted.
        count = arrays.get(name, np.int32(0)).tolist()
        if not (isinstance(count, int) and 0 <= count <= step):
            return f"{name} is {str(count)[:40]}; 0 to {step}, the step, is wanted"
    return None


def _fault(arrays: dict[str, np.ndarray]) -> str | None:
    """What no training leaves behind: numbers that are not finite, squares below 0.

    What stands in an inactive slot does not matter.
    """
    active = arrays.get(".gaussians.active", np.ones(0, bool))
    if active.dtype != bool or active.ndim != 1 or (active.view(np.uint8) > 1).any():
        return ".gaussians.active is no list of what is true or false"
    for name, array in arrays.items():
        if array.dtype.kind != "f":
            continue
        squares = name.startswith((".moments.nu", ".refinement_moments.nu", ".stats"))
        good = np.isfinite(array)
        if squares:
            good &= array >= 0
        if name.startswith(".refinement"):
            bad = ~good
        elif array.shape[:1] == active.shape:
            bad = active & ~good.reshape(len(active), -1).all(axis=1)
        else:  # of other settings, which `restore` tells of
            continue
        if bad.any():
            wanted = "finite numbers" + " of at least 0" * squares
            where = f"{np.argwhere(bad)[0].tolist()} the first"
            return f"{name}: {bad.sum()} of {bad.size} are not {wanted}, {where}"
    return None


def _lengths(arrays: dict[str, np.ndarray]) -> set[int]:
    return {len(array) for array in arrays.values() if array.ndim}


def _entries(path: Path) -> Iterator[tuple[str, bytes]]:
    """Names and bytes in an archive, whose checksums fit; none is unpacked."""
    with opened(path, "a checkpoint") as file:
        try:
            archive = zipfile.ZipFile(file)
            entries = archive.infolist()
        except _ZIP_ERRORS as error:
            raise _damaged(path, error) from error
        size = path.stat().st_size
        declared = sum(entry.file_size for entry in entries)
        faults = {
            "compressed": any(entry.compress_type for entry in entries),
            "more than it can hold": declared > size,
            "of one name": len({entry.filename for entry in entries}) < len(entries),
        }
        fault = next((fault for fault, found in faults.items() if found), None)
        if fault is not None:
            raise InputError(
                f"{path}: no readable checkpoint: {len(entries)} arrays, {fault}, in "
                f"{declared} bytes ({size} are there); {_REMEDY}"
            )
        for entry in entries:
            try:
                data = archive.read(entry)
            except _ZIP_ERRORS as error:
                where = f"{entry.filename[:80]} (byte {entry.header_offset})"
                raise _damaged(path, error, where) from error
            yield entry.filename, data


def _damaged(path: Path, error: Exception, where: str = "") -> InputError:
    told = f"{where}: {error}" if where else f"{error}"
    return InputError(f"{path}: damaged checkpoint: {told}; {_REMEDY}")


def restore(checkpoint: Checkpoint, template: TrainState) -> TrainState:
    """The state of a checkpoint.

    Args:
      checkpoint: as read.
      template: a state with the same settings and capacity.

    Raises:
      InputError: if the settings are others than those that it was written under.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    if set(names) != set(checkpoint.arrays):
        differing = sorted(set(names) ^ set(checkpoint.arrays))[:3]
        raise InputError(
            f"{checkpoint.path}: the checkpoint of step {checkpoint.step} is of other "
            f"settings: {differing} differ; pass those of the run, or train anew"
        )
    out = []
    for name, (_, leaf) in zip(names, leaves):
        array = checkpoint.arrays[name]
        wanted = jax.random.key_data(leaf) if _is_key(leaf) else leaf
        if array.shape != wanted.shape or array.dtype != wanted.dtype:
            raise InputError(
                f"{checkpoint.path}: the checkpoint of step {checkpoint.step} has "
                f"{name} as {array.dtype} {array.shape}; {wanted.dtype} {wanted.shape} "
                "is wanted: its settings are others; pass those of the run, or train "
                "anew"
            )
        value = jnp.asarray(array)
        out.append(jax.random.wrap_key_data(value) if _is_key(leaf) else value)
    return jax.tree_util.tree_unflatten(structure, out)
