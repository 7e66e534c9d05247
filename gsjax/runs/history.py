"""Logs of a run: .jsonl files written and read, and their plot."""

import io
import json
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images
from gsjax.plots.figures import Series, curves
from gsjax.runtime.files import append_to_file, finite_or_none, read_bytes, write_file

_REQUIRED = ("step", "seconds", "gaussians")
_BUFFERED = 20  # lines written together


def _line(record: dict[str, Any]) -> str:
    values = (finite_or_none(v) if isinstance(v, float) else v for v in record.values())
    return json.dumps(dict(zip(record, values)), allow_nan=False) + "\n"


class JsonlLog:
    """Buffered writer that appends records to a `.jsonl` file.

    Lines that a full disk rejects stay buffered and are written later if possible.
    """

    def __init__(self, path: Path):
        self.path = path
        self._lines: list[str] = []

    def add(self, record: dict[str, Any]) -> None:
        """Append a record; a failed automatic write is retried later."""
        self._lines.append(_line(record))
        if len(self._lines) % _BUFFERED == 0:
            with suppress(InputError):
                self.write()

    def write(self) -> None:
        """Write all buffered lines; raise `InputError` if that fails."""
        if self._lines:
            append_to_file(self.path, "".join(self._lines).encode())
            self._lines.clear()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the records of a `metrics.jsonl` or `held_out.jsonl`; [] if it is missing.

    A truncated last line is ignored; other malformed lines raise a warning.

    Raises:
      InputError: if the file cannot be read.
    """
    if not path.exists():
        return []
    records, malformed = [], []
    for number, line in enumerate(io.BytesIO(read_bytes(path, "a metrics.jsonl")), 1):
        record = _parse(line)
        truncated = not line.endswith(b"\n") and b'{"'.startswith(line[:2])
        if record is not None:
            records.append(record)
        elif not truncated and line.strip():
            malformed.append(number)
    if malformed:
        warnings.warn(
            f"{path}: {len(malformed)} of {len(records) + len(malformed)} lines are "
            f"malformed and skipped, the first is line {malformed[0]}; train again for "
            "a complete log",
            stacklevel=2,
        )
    return records


def _parse(line: bytes) -> dict[str, Any] | None:
    """Return the record of a line; None if it is malformed."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict):
        return None
    psnr = record.get("psnr", "missing")  # null if it is not finite
    values: list[Any] = [record.get(key) for key in _REQUIRED]
    values.append(0 if psnr is None else psnr)
    good = all(type(v) in (int, float) and abs(v) < 1e300 for v in values)
    return record if good else None


def truncate_log(path: Path, steps: int) -> None:
    """Drop the records after step ``steps``, at which a run resumes."""
    if path.exists():
        kept = [_line(r) for r in read_metrics(path) if r["step"] <= steps]
        write_file(path, "".join(kept).encode())


def plot_curves(
    path: Path,
    metrics: list[dict[str, Any]],
    window: int,
    held_out: Sequence[dict[str, Any]] = (),
) -> None:
    """Plot PSNR by step: of each training view, its running mean, and held-out views.

    Steps at which the image size changes are marked.

    Args:
      path: PNG to write, as `write_file`; replaced if it exists.
      metrics, held_out: see `read_metrics`.
      window: steps of the running mean, e.g. one epoch.
    """
    steps = np.asarray([record["step"] for record in metrics], float)
    psnr = np.asarray([record["psnr"] for record in metrics], float)
    window = max(1, min(window, len(psnr)))
    finite = np.isfinite(psnr)
    sums = np.cumsum([np.where(finite, psnr, 0), finite], axis=1, dtype=float)
    sums = np.pad(sums, ((0, 0), (1, 0)))
    total, count = sums[:, window:] - sums[:, :-window]
    mean = total / np.where(count > 0, count, np.nan)
    series = [
        Series("view of the step", steps, psnr, faint=True),
        Series(f"mean of {window}", steps[window // 2 :][: len(mean)], mean),
    ]
    if held_out:
        points = [[r["step"] for r in held_out], [r["psnr"] for r in held_out]]
        series.append(Series("held out", *np.asarray(points, float)))
    gaussians = int(metrics[-1]["gaussians"]) if metrics else 0
    plot = curves(
        series,
        title="PSNR in training, dB",
        x_label=f"step ({gaussians:,} Gaussians after the last)",
        marks=_size_changes(metrics),
    )
    write_file(path, images.encode_png(plot))


def _size_changes(metrics: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the first step of each image size; empty if there is only one size."""
    marks: dict[str, float] = {}
    for record in metrics:
        divisor = record.get("divisor")
        if type(divisor) is int:  # older runs lack it
            label = "full size" if divisor == 1 else f"1/{divisor} of the size"
            marks.setdefault(label, record["step"])
    return marks if len(marks) > 1 else {}
