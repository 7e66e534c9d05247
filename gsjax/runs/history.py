"""What a run wrote of its steps, read back, and as a picture."""

import io
import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError
from gsjax.plots.curves import Mark, Series, curves_png
from gsjax.runtime.files import append_to_file, finite_or_none, read_bytes, write_file

_NEEDED = ("step", "seconds", "gaussians")
_LINES = 20  # written together


def record_line(record: dict[str, Any]) -> str:
    """A line of a `.jsonl`."""
    plain = {
        k: finite_or_none(v) if isinstance(v, float) else v for k, v in record.items()
    }
    return json.dumps(plain, allow_nan=False) + "\n"


class Journal:
    """Lines for the end of a `.jsonl`, kept in memory until they are written.

    What a full disk does not take is kept on, and written later if that is possible.
    """

    def __init__(self, path: Path):
        self.path = path
        self._lines: list[str] = []

    def add(self, record: dict[str, Any]) -> None:
        """A line more; every so many are written, or stay for the next time."""
        self._lines.append(record_line(record))
        if len(self._lines) % _LINES == 0:
            with suppress(InputError):
                self.write()

    def write(self) -> None:
        """Write what is not yet.

        Raises:
          InputError: if it cannot be written.
        """
        if self._lines:
            append_to_file(self.path, "".join(self._lines).encode())
            self._lines.clear()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Records of a `metrics.jsonl` or `held_out.jsonl`; none if it is not there.

    A last one that a kill cut short is left out; of what else is none, it is warned.

    Raises:
      InputError: if it cannot be read.
    """
    if not path.exists():
        return []
    lines, odd = [], []
    for number, line in enumerate(_lines(path), 1):
        record = _record(line)
        if record is not None:
            lines.append(record)
        elif not _is_cut_short(line) and line.strip():
            odd.append(number)
    if odd:
        warnings.warn(
            f"{path}: {len(odd)} of {len(lines) + len(odd)} lines are no records of a "
            f"step and left out, the first: line {odd[0]}; the file is damaged: train "
            "anew for a whole one",
            UserWarning,
            stacklevel=2,
        )
    return lines


def _is_cut_short(line: bytes) -> bool:
    return not line.endswith(b"\n") and b'{"'.startswith(line[:2])


def _lines(path: Path) -> Iterator[bytes]:
    """Of a file, whose content is not held a second time."""
    return iter(io.BytesIO(read_bytes(path, "a metrics.jsonl")))


def _record(line: bytes) -> dict[str, Any] | None:
    """What a line holds; None if that is no record."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    good = isinstance(record, dict) and all(map(_is_number, _needed(record)))
    return record if good else None


def keep_steps(path: Path, steps: int) -> None:
    """Drop what was logged after the checkpoint that a run goes on from.

    Raises:
      InputError: if it cannot be written.
    """
    if path.exists():
        kept = [record_line(r) for r in read_metrics(path) if r["step"] <= steps]
        write_file(path, "".join(kept).encode())


def _needed(record: dict[str, Any]) -> list[Any]:
    """Values that a line has; the PSNR is null where it is not finite."""
    psnr = record.get("psnr", "missing")
    return [record.get(key) for key in _NEEDED] + [0 if psnr is None else psnr]


def _is_number(value) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300


def write_curves(
    path: Path,
    metrics: list[dict[str, Any]],
    window: int,
    held_out: Sequence[dict[str, Any]] = (),
) -> None:
    """PSNR by step: of the view that each step saw, its mean, and of held-out views.

    A thin line marks where the size of the images changed, if the records have it.

    Args:
      path: of the PNG; replaced if it exists.
      metrics, held_out: see `read_metrics`.
      window: steps of the mean: an epoch has seen all views.

    Raises:
      InputError: if it cannot be written.
    """
    steps = np.asarray([record["step"] for record in metrics], float)
    psnr = np.asarray([record["psnr"] for record in metrics], float)
    window = max(1, min(window, len(psnr)))
    good = np.isfinite(psnr)
    both = np.cumsum([np.where(good, psnr, 0), good], axis=1, dtype=float)
    both = np.pad(both, ((0, 0), (1, 0)))
    total, count = both[:, window:] - both[:, :-window]
    mean = total / np.where(count > 0, count, np.nan)
    left = int(metrics[-1]["gaussians"]) if metrics else 0
    series = [
        Series("view of the step", steps, psnr, faint=True),
        Series(f"mean of {window}", steps[window // 2 :][: len(mean)], mean),
    ]
    if held_out:
        points = [[r["step"] for r in held_out], [r["psnr"] for r in held_out]]
        series.append(Series("held out", *np.asarray(points, float)))
    curves_png(
        path,
        series,
        title="PSNR in training, dB",
        # At the end more are dropped, those that no photograph shows.
        x_label=f"step ({left:,} Gaussians after the last)",
        marks=_sizes(metrics),
    )


def _sizes(metrics: Sequence[dict[str, Any]]) -> list[Mark]:
    """Where images of another size began, unless all were of one."""
    marks: list[Mark] = []
    for record in metrics:
        divisor = record.get("divisor")
        if type(divisor) is not int:  # of an older run
            continue
        label = "full size" if divisor == 1 else f"1/{divisor} of the size"
        if not marks or marks[-1].label != label:
            marks.append(Mark(label, record["step"]))
    return marks if len(marks) > 1 else []
