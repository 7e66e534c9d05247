"""What a stress case is, and what came out of it."""

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Measured(NamedTuple):
    """What a case found.

    Attributes:
      value: to be compared with the bound; lower is better, NaN is outside of any.
      note: what it was measured over, and what else is worth to know.
      more: for the JSON alone.
    """

    value: float
    note: str = ""
    more: dict[str, Any] | None = None


@dataclass(frozen=True)
class Case:
    """One claim with its bound.

    Attributes:
      name: topic/claim.
      claim: what is measured, in a few words.
      bound: the largest value that is well; 0 for what must not happen at all.
      measure: ``full`` → `Measured`; over more where ``full`` is set.
      unit: of the value.
      full_only: left out of the short form, for its time.
    """

    name: str
    claim: str
    bound: float
    measure: Callable[[bool], Measured]
    unit: str = ""
    full_only: bool = False


class Result(NamedTuple):
    """A case as measured.

    Attributes:
      good: whether ``measured`` is within the bound.
      error: the exception that ended it, or "".
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


def worse(a: float, b: float) -> float:
    """The larger of two errors; a NaN is the worst of all, which `max` may forget."""
    return b if b > a or b != b else a


def run_case(case: Case, full: bool) -> Result:
    """Measure; an exception is a case outside its bound, not the end of the others."""
    start, error = time.perf_counter(), ""
    try:
        measured = case.measure(full)
    except Exception as caught:
        where = traceback.extract_tb(caught.__traceback__)[-1]
        told = " ".join(str(caught).split())[:200]
        error = f"{type(caught).__name__}: {told} ({where.name})"
        measured = Measured(float("nan"))
    value = float(measured.value)
    return Result(
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
