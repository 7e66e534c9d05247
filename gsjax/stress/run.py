"""Run the cases and write the scoreboard: lines, Markdown, JSON."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from gsjax.errors import InputError
from gsjax.runtime.files import finite_or_none, write_file
from gsjax.runtime.timing import machine
from gsjax.stress import (
    accuracy,
    compositing,
    extremes,
    learning,
    lenses,
    needles,
    poison,
    precision,
)
from gsjax.stress.types import CaseResult, StressCase, run_case

CASES: tuple[StressCase, ...] = (
    *needles.CASES,
    *extremes.CASES,
    *poison.CASES,
    *lenses.CASES,
    *compositing.CASES,
    *learning.CASES,
    *precision.CASES,
    *accuracy.CASES,
)
_MARKS = ("<!-- gsjax stress -->", "<!-- /gsjax stress -->")


def select_cases(full: bool) -> tuple[StressCase, ...]:
    """Return the cases of the full or the short form."""
    return tuple(c for c in CASES if full or not c.full_only)


def run_cases(cases: tuple[StressCase, ...], full: bool) -> Iterator[CaseResult]:
    """Yield the result of each case, measured in float32 whatever the x64 setting."""
    for case in cases:
        with jax.enable_x64(False):
            result = run_case(case, full)
        yield result


def margin(result: CaseResult) -> float | None:
    """Return bound / measured, or None if either is 0."""
    if result.bound == 0 or not result.measured > 0:
        return None
    return result.bound / result.measured


def _number(value: float) -> str:
    return (
        "0" if value == 0 else f"{value:.2g}" if 0.01 <= value < 1e4 else f"{value:.1e}"
    )


def _cells(result: CaseResult) -> tuple[str, str, str]:
    """Return the measured value, the bound and the margin as text."""
    unit = f" {result.unit}" if result.unit else ""
    times = margin(result)
    ratio = "" if times is None else f"{times:.3g} ×"
    ratio = "exact" if result.measured == 0 else ratio
    return f"{_number(result.measured)}{unit}", f"{_number(result.bound)}{unit}", ratio


def line(result: CaseResult) -> str:
    """Return a line: verdict, case, measured value, bound, margin, note."""
    measured, bound, ratio = _cells(result)
    verdict = "ok " if result.good else "RED"
    note = result.error or result.note
    cells = f"{result.name:<31}{measured:>11} of {bound:<11}{ratio:>10}"
    return f"{verdict} {cells}  {note}".rstrip()


def summary(results: list[CaseResult]) -> str:
    """Return the number of cases within their bounds and the total time."""
    good, seconds = sum(r.good for r in results), sum(r.seconds for r in results)
    return f"{good} of {len(results)} cases within their bounds, {seconds:.0f} s"


def as_json(results: list[CaseResult], full: bool) -> dict[str, Any]:
    """Return all results and the machine for a JSON file; NaN becomes None."""
    return {
        "machine": machine(),
        "form": "full" if full else "short",
        "rows": [
            {
                **{k: v for k, v in result._asdict().items() if k != "more"},
                "measured": finite_or_none(result.measured),
                "margin": margin(result),
                **({"more": result.more} if result.more else {}),
            }
            for result in results
        ],
    }


def markdown(report: dict[str, Any]) -> str:
    """Return the table of the results of `as_json`."""
    rows = [_result(row) for row in report["rows"]]
    lines = ["| case | what | measured | bound | margin |", "|---|---|---|---|---|"]
    for row in rows:
        measured, bound, ratio = _cells(row)
        mark = "" if row.good else " **(outside)**"
        cells = (row.name, row.claim, measured + mark, bound, ratio)
        escaped = (cell.replace("|", r"\|") for cell in cells)  # a bare | ends a cell
        lines.append(f"| {' | '.join(escaped)} |")
    for row in rows:
        if not row.good:
            lines += ["", f"{row.name}: {row.error or row.note}."]
    where = report["machine"]
    good = sum(row.good for row in rows)
    lines += [
        "",
        f"{good} of {len(rows)} within their bounds; {report['form']} form, "
        f"jax {where['jax']}, {where['cpu']}, {where['devices']}, {where['date']}.",
    ]
    return "\n".join(lines)


def _result(row: dict[str, Any]) -> CaseResult:
    """Return the result of a row of `as_json`."""
    fields = {name: row.get(name) for name in CaseResult._fields}
    measured = float("nan") if row["measured"] is None else row["measured"]
    return CaseResult(**{**fields, "measured": measured})


def around_marks(path: Path) -> tuple[str, str]:
    """Split a Markdown file before and after the text between the two marks.

    Raises:
      InputError: if the file does not exist, is not UTF-8 or lacks the marks.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; create it with the marks of the table")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8"
        ) from error
    before, found, rest = text.partition(_MARKS[0])
    _, closed, after = rest.partition(_MARKS[1])
    if not found or not closed or _MARKS[0] in rest:
        raise InputError(
            f"{path}: no marks for the table; add the lines {_MARKS[0]} and {_MARKS[1]}"
        )
    return before + found, closed + after


def put_between_marks(path: Path, table: str) -> None:
    """Replace the text between the two marks of a Markdown file.

    Raises:
      InputError: as `around_marks`.
    """
    before, after = around_marks(path)
    write_file(path, f"{before}\n{table}\n{after}".encode())
