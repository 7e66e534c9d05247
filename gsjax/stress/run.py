"""All cases, one after another: the scoreboard as lines, as Markdown, as JSON."""

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
    needles,
    poison,
    precision,
)
from gsjax.stress.types import Case, Result, run_case

CASES: tuple[Case, ...] = (
    *needles.CASES,
    *extremes.CASES,
    *poison.CASES,
    *compositing.CASES,
    *learning.CASES,
    *precision.CASES,
    *accuracy.CASES,
)
_MARKS = ("<!-- gsjax stress -->", "<!-- /gsjax stress -->")


def chosen(full: bool) -> tuple[Case, ...]:
    """The cases of the full or the short form."""
    return tuple(c for c in CASES if full or not c.full_only)


def run_cases(cases: tuple[Case, ...], full: bool) -> Iterator[Result]:
    """Each case as it is measured, in float32 whatever the caller's setting."""
    for case in cases:
        with jax.enable_x64(False):
            result = run_case(case, full)
        yield result


def margin(result: Result) -> float | None:
    """How many times the measured value goes into the bound; None without a ratio."""
    if result.bound == 0 or not result.measured > 0:
        return None
    return result.bound / result.measured


def _number(value: float) -> str:
    return (
        "0" if value == 0 else f"{value:.2g}" if 0.01 <= value < 1e4 else f"{value:.1e}"
    )


def _cells(result: Result) -> tuple[str, str, str]:
    """Measured, bound and margin, to read."""
    unit = f" {result.unit}" if result.unit else ""
    room = margin(result)
    ratio = "exact" if result.measured == 0 else "" if room is None else f"{room:.3g} ×"
    return f"{_number(result.measured)}{unit}", f"{_number(result.bound)}{unit}", ratio


def line(result: Result) -> str:
    """One line of the scoreboard: verdict, case, measured, bound, margin, over what."""
    measured, bound, ratio = _cells(result)
    verdict = "ok " if result.good else "RED"
    told = result.error or result.note
    return (
        f"{verdict} {result.name:<31}{measured:>11} of {bound:<11}{ratio:>10}  {told}"
    ).rstrip()


def summary(results: list[Result]) -> str:
    """How many are within their bounds, and in what time."""
    good, seconds = sum(r.good for r in results), sum(r.seconds for r in results)
    return f"{good} of {len(results)} cases within their bounds, {seconds:.0f} s"


def as_json(results: list[Result], full: bool) -> dict[str, Any]:
    """Everything measured, and on what; a NaN is None."""
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


def markdown(told: dict[str, Any]) -> str:
    """The scoreboard of `as_json` as a table, a row a case."""
    rows = [_result(row) for row in told["rows"]]
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
    where = told["machine"]
    good = sum(row.good for row in rows)
    lines += [
        "",
        f"{good} of {len(rows)} within their bounds; {told['form']} form, "
        f"jax {where['jax']}, {where['cpu']}, {where['devices']}, {where['date']}.",
    ]
    return "\n".join(lines)


def _result(row: dict[str, Any]) -> Result:
    """What a row of `as_json` was made of."""
    fields = {name: row.get(name) for name in Result._fields}
    measured = float("nan") if row["measured"] is None else row["measured"]
    return Result(**{**fields, "measured": measured})


def around_marks(path: Path) -> tuple[str, str]:
    """What stands in a Markdown file up to the first mark, and from the second on.

    Raises:
      InputError: if it has no such lines, each once and in order, or is not there.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file to put the table into")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8; save it as that"
        ) from error
    before, found, rest = text.partition(_MARKS[0])
    _, closed, after = rest.partition(_MARKS[1])
    if not found or not closed or _MARKS[0] in rest:
        raise InputError(
            f"{path}: no place for the table; put the lines {_MARKS[0]} and "
            f"{_MARKS[1]} where it is to go"
        )
    return before + found, closed + after


def put_between_marks(path: Path, table: str) -> None:
    """Replace what stands between the two marks in a Markdown file.

    Raises:
      InputError: as `around_marks`.
    """
    before, after = around_marks(path)
    write_file(path, f"{before}\n{table}\n{after}".encode())
