"""Numbers that a caller passes: of the type wanted, or an error that names them.

NumPy's count as Python's do, and become these: a `numpy.float64` in a program of
float32 would widen all it touches, where a Python float does not.
"""

import math
import operator
from dataclasses import fields
from functools import cache
from numbers import Real
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

import numpy as np

from gsjax.errors import InputError


def whole(name: str, value: Any) -> int:
    """``value`` as an int.

    Raises:
      InputError: if it is no whole number; ``name`` says which.
    """
    if not isinstance(value, (bool, np.bool_)):
        try:
            return operator.index(value)
        except TypeError:
            if isinstance(value, Real) and float(value).is_integer():
                return int(float(value))
    raise InputError(f"{name} = {value!r}: a whole number is wanted")


def number(name: str, value: Any) -> float:
    """``value`` as a float.

    Raises:
      InputError: if it is no real number, or not finite, which files of settings
        cannot hold; ``name`` says which.
    """
    if isinstance(value, Real) and not isinstance(value, bool):
        value = float(value)
        if math.isfinite(value):
            return value
    raise InputError(f"{name} = {value!r}: a finite number is wanted")


def _flag(name: str, value: Any) -> bool:
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise InputError(f"{name} = {value!r}: True or False is wanted")


_KINDS = {int: whole, float: number, bool: _flag}


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def settle(settings: Any) -> None:
    """Bring the numbers of a frozen dataclass to the types of its fields, in place.

    For `__post_init__`. Fields that are neither a number nor a flag, nor one of these
    or None, stay as they are.

    Raises:
      InputError: if one is of another kind; by class and field.
    """
    kind = type(settings)
    hints = _hints(kind)
    for name in (field.name for field in fields(settings)):
        value, hint = getattr(settings, name), hints[name]
        if isinstance(hint, UnionType):
            if value is None and NoneType in get_args(hint):
                continue
            hint = get_args(hint)[0]
        if hint in _KINDS:
            settled = _KINDS[hint](f"{kind.__name__}.{name}", value)
            object.__setattr__(settings, name, settled)


def require_ranges(settings: Any, checks: dict[str, bool]) -> None:
    """See that all of a dataclass's settings are as they should be.

    Args:
      settings: the dataclass.
      checks: whether they are, by their names; of more than one, any words.

    Raises:
      InputError: if one is not; by class and name, with what was found.
    """
    for name, good in checks.items():
        if not good:
            found = getattr(settings, name.split("'")[0], name)
            raise InputError(
                f"{type(settings).__name__}.{name} = {found!r} is out of range; see "
                "its documentation"
            )
