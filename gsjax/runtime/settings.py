"""Checks of the numbers that a caller passes.

NumPy's numbers become Python's: a `numpy.float64` in a float32 program would promote
everything it touches, and a Python float does not.
"""

import math
import operator
import re
from dataclasses import fields
from functools import cache
from numbers import Real
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

import numpy as np

from gsjax.errors import InputError


def as_int(name: str, value: Any) -> int:
    """Return an integer as an int.

    Raises:
      InputError: if ``value`` is not an integer; ``name`` is that of the argument.
    """
    if not isinstance(value, (bool, np.bool_)):
        try:
            return operator.index(value)
        except TypeError:
            if isinstance(value, Real) and float(value).is_integer():
                return int(float(value))
    raise InputError(f"{name}: expected a whole number, got {value!r}")


def as_float(name: str, value: Any) -> float:
    """Return a real number as a float.

    Raises:
      InputError: if ``value`` is not a finite real number, as JSON cannot store it;
        ``name`` is that of the argument.
    """
    if isinstance(value, Real) and not isinstance(value, bool):
        value = float(value)
        if math.isfinite(value):
            return value
    raise InputError(f"{name}: expected a finite number, got {value!r}")


def _as_bool(name: str, value: Any) -> bool:
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise InputError(f"{name}: expected True or False, got {value!r}")


_CONVERT = {int: as_int, float: as_float, bool: _as_bool}
_hints = cache(get_type_hints)


def convert_fields(settings: Any) -> None:
    """Convert numbers and flags of a frozen dataclass to their annotated types in
    place.

    For `__post_init__`. Other fields, and None where it is allowed, are left alone.

    Raises:
      InputError: if a value has another type; names the class and the field.
    """
    kind = type(settings)
    hints = _hints(kind)
    for name in (field.name for field in fields(settings)):
        value, hint = getattr(settings, name), hints[name]
        if isinstance(hint, UnionType):
            if value is None and NoneType in get_args(hint):
                continue
            hint = get_args(hint)[0]
        if hint in _CONVERT:
            converted = _CONVERT[hint](f"{kind.__name__}.{name}", value)
            object.__setattr__(settings, name, converted)


def require_ranges(settings: Any, checks: dict[str, str | tuple]) -> None:
    """Check the values of a dataclass.

    Args:
      settings: the dataclass.
      checks: by field, or by "field's part": an interval such as "[1, inf)", which None
        is always in; a tuple of choices; or whether the value is good, and the values
        expected.

    Raises:
      InputError: if a value is not allowed; names the class and the field.
    """
    for name, allowed in checks.items():
        found = getattr(settings, name.split("'")[0], name)
        if isinstance(allowed, str):
            good, expected = _within(found, allowed), f"a number in {allowed}"
        elif isinstance(allowed[0], bool):
            good, expected = allowed
        else:
            good, expected = found in allowed, f"one of {', '.join(map(str, allowed))}"
        if not good:
            where = f"{type(settings).__name__}.{name}"
            raise InputError(f"{where}: expected {expected}, got {found!r}")


def _within(value: Any, interval: str) -> bool:
    match = re.fullmatch(r"([\[(])(.+), (.+)([\])])", interval)
    assert match is not None, interval
    opening, low, high, closing = match.groups()
    return value is None or (
        (float(low) <= value if opening == "[" else float(low) < value)
        and (value <= float(high) if closing == "]" else value < float(high))
    )
