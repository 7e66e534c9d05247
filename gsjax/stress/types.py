"""Types of a stress case and of its result."""

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Measurement(NamedTuple):
    """Outcome of the measurement of a case.

    Attributes:
      value: compared with the bound; lower is better, NaN is out of bounds.
      note: the inputs it was measured on, and other values of interest.
      more: details for the JSON report.
    """

    value: float
    note: str = ""
    more: dict[str, Any] | None = None


@dataclass(frozen=True)
class StressCase:
    """A claim with a bound.

    Attributes:
      name: topic/claim.
      claim: the measured quantity in a few words.
      bound: largest acceptable value; 0 for events that must not occur.
      measure: ``full`` → `Measurement`; ``full`` asks for more scenes and values.
      unit: unit of the value.
      full_only: whether the short form omits the case because of its duration.
    """

    name: str
    claim: str
    bound: float
    measure: Callable[[bool], Measurement]
    unit: str = ""
    full_only: bool = False


class CaseResult(NamedTuple):
    """A case with its measurement.

    Attributes:
      name, claim, bound, unit: of the case.
      measured, note, more: of the measurement.
      good: whether ``measured`` is within the bound.
      seconds: duration.
      error: the exception that ended the measurement, or "".
    """

    name: str
    claim: str
    measured: float
    bound: float
    unit: str
    good: bool
    seconds: float
    note: str
    error: str
    more: dict[str, Any] | None


def run_case(case: StressCase, full: bool) -> CaseResult:
    """Measure a case; an exception puts it out of bounds and is recorded."""
    start, error = time.perf_counter(), ""
    try:
        measured = case.measure(full)
    except Exception as caught:
        where = traceback.extract_tb(caught.__traceback__)[-1]
        message = " ".join(str(caught).split())[:200]
        error = f"{type(caught).__name__}: {message} ({where.name})"
        measured = Measurement(float("nan"))
    value = float(measured.value)
    return CaseResult(
        name=case.name,
        claim=case.claim,
        measured=value,
        bound=case.bound,
        unit=case.unit,
        good=value <= case.bound,
        seconds=time.perf_counter() - start,
        note=measured.note,
        error=error,
        more=measured.more,
    )
