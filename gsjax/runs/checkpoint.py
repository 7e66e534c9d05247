"""Checkpoints: the whole state of a run in one file, written completely or not at all.

An .npz holds every array of the state under its path in the pytree, each with the CRC
of the zip format, and a JSON entry of metadata. The latest two files are kept, so that
a file damaged later costs one interval rather than the run.
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

import numpy as np

from gsjax.errors import InputError
from gsjax.io.npy import read_npy
from gsjax.runtime.files import make_folder, opened, write_file
from gsjax.train.state import TrainState, state_arrays, state_from_arrays

_KEEP = 2
_FORMAT = 1
_META = "meta.json"
_REMEDY = "remove it to resume from the previous one, or train again"
# Errors that zipfile raises on damaged archives.
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError),
    *(EOFError, KeyError, OverflowError, struct.error),
)


class Checkpoint(NamedTuple):
    """The content of a checkpoint file.

    Attributes:
      path: the file.
      step: step at which it was written.
      arrays: arrays by their path in the state.
      meta: metadata saved with them: ``capacity``, ``pair_capacity``, …
    """

    path: Path
    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]


def save_checkpoint(folder: Path, state: TrainState, meta: dict[str, Any]) -> Path:
    """Write the state to a new file; remove all but the latest two checkpoints.

    Args:
      folder, state: the folder is created if missing.
      meta: JSON values to store: ``pair_capacity``, ``seconds`` of training, and
        optionally ``visible_capacity`` and the number of ``devices``.

    Raises:
      InputError: if writing fails; earlier checkpoints are kept.
    """
    make_folder(folder)
    arrays, step = state_arrays(state), int(state.step)
    header = {**meta, "format": _FORMAT, "step": step}
    header["capacity"], header["arrays"] = state.gaussians.capacity, sorted(arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    buffer = io.BytesIO()
    if any(array.dtype.hasobject for array in arrays.values()):
        # NumPy below 2.2 has no argument to reject them.
        raise TypeError("state: expected numeric arrays, got an array of objects")
    np.savez(buffer, **{_META: encoded, **arrays})  # pyright: ignore
    path = folder / f"step_{step:09d}.npz"
    # A view that an exception keeps alive would keep the buffer from being freed.
    with buffer.getbuffer() as data:
        write_file(path, data, durable=True)
    # Later files, unreadable to the run that resumed before them, do not count.
    upto = [old for old in _files(folder) if old.name <= path.name]
    for old in upto[:-_KEEP]:
        old.unlink(missing_ok=True)
    return path


def latest_step(folder: Path) -> int | None:
    """Return the step in the name of the last checkpoint; None if there is none."""
    files = _files(folder)
    return int(files[-1].stem.removeprefix("step_")) if files else None


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"step_{'[0-9]' * 9}.npz"))


def load_latest(folder: Path, steps: int | None = None) -> Checkpoint:
    """Return the latest readable checkpoint of a run of ``steps``; warn of later ones.

    Raises:
      InputError: if no checkpoint is readable.
    """
    failed = []
    for path in reversed(_files(folder)):
        try:
            found = load_checkpoint(path, steps)
        except InputError as error:
            failed.append(str(error))
            continue
        for message in failed:
            warnings.warn(f"{message}; resuming from {path.name}", stacklevel=2)
        return found
    details = f" ({'; '.join(failed)})" if failed else ""
    raise InputError(f"{folder}: no checkpoint to resume from{details}; train again")


def load_checkpoint(path: Path, steps: int | None = None) -> Checkpoint:
    """Read and check one file, whose step is at most ``steps`` if given.

    Raises:
      InputError: if the file is damaged, truncated or no checkpoint, or holds values
        that no run produces.
    """
    where = f"{path}: not a readable checkpoint"
    arrays = archived_arrays(path, "a checkpoint")
    if _META not in arrays:
        raise InputError(f"{where}: {_META} is missing; {_REMEDY}")
    try:
        meta = json.loads(arrays.pop(_META).tobytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: {_META}: {str(error)[:80]}; {_REMEDY}") from error
    lengths = {len(array) for array in arrays.values() if array.ndim}
    checks = {
        "format": lambda value: value == _FORMAT,
        "step": lambda value: type(value) is int and value >= 0,
        "capacity": lambda value: type(value) is int and value in lengths,
        "pair_capacity": lambda value: type(value) is int and 0 <= value < 2**30,
        "visible_capacity": lambda value: value is None or _is_count(value),
        "seconds": lambda value: type(value) in (int, float) and 0 <= value < math.inf,
        "arrays": lambda value: value == sorted(arrays),
        "devices": lambda value: value is None or (type(value) is int and value >= 1),
    }
    meta = meta if isinstance(meta, dict) else {}
    for key, valid in checks.items():
        if not valid(meta.get(key)):
            found = repr(meta.get(key, "missing"))[:80]
            expected = f" (expected {_FORMAT})" if key == "format" else ""
            raise InputError(f"{where}: {_META}: {key} {found}{expected}; {_REMEDY}")
    fault = _step_fault(path, arrays, meta["step"], steps) or _value_fault(arrays)
    if fault is not None:
        raise InputError(f"{path}: damaged checkpoint: {fault}; {_REMEDY}")
    return Checkpoint(path, meta["step"], arrays, meta)


def _is_count(value: Any) -> bool:
    return type(value) is int and 1 <= value < 2**31


def _step_fault(
    path: Path, arrays: dict[str, np.ndarray], step: int, steps: int | None
) -> str | None:
    """Return what contradicts the step in the metadata, or None."""
    named = re.fullmatch(r"step_(\d{9})\.npz", path.name)
    if named is not None and int(named[1]) != step:
        return f"{_META} says step {step}, but the file name another"
    if steps is not None and step > steps:
        return f"{_META} says step {step} of a run of {steps} (config.json)"
    stored = arrays.get(".step", np.int32(step)).tolist()
    if stored != step:
        return f".step is {str(stored)[:40]}, but {_META} says {step}"
    for name in (".moments[0].count", ".shared_moments[0].count"):
        # Steps without a gradient are not counted.
        count = arrays.get(name, np.int32(0)).tolist()
        if not (isinstance(count, int) and 0 <= count <= step):
            return f"expected {name} from 0 to {step}, the step, got {str(count)[:40]}"
    return None


def _value_fault(arrays: dict[str, np.ndarray]) -> str | None:
    """Return the first non-finite number or negative square of active slots."""
    active = arrays.get(".gaussians.active", np.ones(0, bool))
    if active.dtype != bool or active.ndim != 1 or (active.view(np.uint8) > 1).any():
        return ".gaussians.active: expected a list of booleans"
    for name, array in arrays.items():
        if array.dtype.kind != "f":
            continue
        squares = name.startswith((".moments[0].nu", ".shared_moments[0].nu", ".stats"))
        good = np.isfinite(array)
        if squares:
            good &= array >= 0
        if name.startswith((".refinement", ".shared_moments", ".model.shared")):
            bad = ~good
        elif array.shape[:1] == active.shape:
            bad = active & ~good.reshape(len(active), -1).all(axis=1)
        else:  # other settings: `restore` reports them
            continue
        if bad.any():
            expected = "finite numbers" + " of at least 0" * squares
            where = f"{np.argwhere(bad)[0].tolist()} first"
            return f"{name}: {bad.sum()} of {bad.size} are not {expected}, {where}"
    return None


def archived_arrays(path: Path, wanted: str) -> dict[str, np.ndarray]:
    """Return the arrays of an uncompressed .npz by name; ``wanted`` is what it holds.

    Raises:
      InputError: if the file is missing, damaged or truncated.
    """
    return {
        name.removesuffix(".npy"): read_npy(f"{path}: {name}", data)
        for name, data in _entries(path, wanted)
    }


def _entries(path: Path, wanted: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of each uncompressed entry with a matching checksum."""
    with opened(path, wanted) as file:
        try:
            archive = zipfile.ZipFile(file)
            entries = archive.infolist()
        except _ZIP_ERRORS as error:
            raise _damaged(path, error) from error
        size = path.stat().st_size
        declared = sum(entry.file_size for entry in entries)
        faults = {
            "compressed": any(entry.compress_type for entry in entries),
            "larger than the file": declared > size,
            "with equal names": len({e.filename for e in entries}) < len(entries),
        }
        fault = next((fault for fault, found in faults.items() if found), None)
        if fault is not None:
            raise InputError(
                f"{path}: not {wanted}: {len(entries)} arrays, {fault}, "
                f"of {declared} bytes in a file of {size}; {_REMEDY}"
            )
        for entry in entries:
            try:
                data = archive.read(entry)
            except _ZIP_ERRORS as error:
                where = f"{entry.filename[:80]} (byte {entry.header_offset}): "
                raise _damaged(path, error, where) from error
            yield entry.filename, data


def _damaged(path: Path, error: Exception, where: str = "") -> InputError:
    return InputError(f"{path}: damaged checkpoint: {where}{error}; {_REMEDY}")


def restore(checkpoint: Checkpoint, template: TrainState) -> TrainState:
    """Return the state of a checkpoint; ``template`` has its settings and capacity.

    Raises:
      InputError: if the checkpoint was written under other settings.
    """
    where = f"{checkpoint.path}: the checkpoint of step {checkpoint.step}"
    return state_from_arrays(where, checkpoint.arrays, template)
