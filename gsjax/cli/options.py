"""Types of command-line options: each parses one argument and checks its range.

They are tyro constructors; a `ValueError` becomes a one-line error.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from tyro.conf import arg
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo
from tyro.constructors import PrimitiveConstructorSpec as OptionSpec

T = TypeVar("T")
IMAGE_KINDS = ("rgb", "alpha", "depth")
REGISTRY = ConstructorRegistry()
_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?"


def option(
    metavar: str, parse: Callable[[str], T], show: Callable[[T], str] = str
) -> OptionSpec[T | None]:
    """Return a tyro constructor that calls ``parse``; ``show`` is its inverse."""
    return OptionSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda _: True,
        str_from_instance=lambda value: [] if value is None else [show(value)],
    )


def integer(least: int, most: int = 2**31 - 2) -> OptionSpec[int | None]:
    """Return the type of a whole number from ``least`` to ``most``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise ValueError(f"expected a whole number, got {text!r}") from None
        if not least <= value <= most:
            raise ValueError(f"expected {least:,} to {most:,}, got {value}")
        return value

    return option("INT", parse)


def real(least: float, below: float) -> OptionSpec[float | None]:
    """Return the type of a number of at least ``least`` and below ``below``."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ValueError(f"expected a number, got {text!r}") from None
        if not least <= value < below:
            limits = f"at least {least:g} and below {below:g}"
            raise ValueError(f"expected {limits}, got {value:g}")
        return value

    return option("FLOAT", parse)


def suggestion(word: str, names: Iterable[str]) -> str:
    """Return the name that was probably meant, or else all names."""
    names = list(names)
    similar = get_close_matches(word.lower(), names, 1) if len(word) > 2 else []
    return f"did you mean {similar[0]}?" if similar else f"choose {', '.join(names)}"


@REGISTRY.primitive_rule
def _choice(info: PrimitiveTypeInfo) -> OptionSpec | None:
    """Parse `Literal` types, also optional ones."""
    optional = info.type_origin in (Union, UnionType)
    kinds = [k for k in get_args(info.type) if k is not NoneType]
    kind = kinds[0] if optional and len(kinds) == 1 else info.type
    if get_origin(kind) is not Literal:
        return None
    values = {str(value): value for value in get_args(kind)}

    def parse(text: str) -> Any:
        if text not in values:
            raise ValueError(f"unknown value {text!r} ({suggestion(text, values)})")
        return values[text]

    spec = option(f"{{{','.join(values)}}}", parse)
    if any(value.startswith("-") for value in values):  # not a flag
        spec = replace(spec, choices=tuple(values))
    return spec


def _size(text: str) -> tuple[int, int]:
    """Return width and height of a size like ``800x600``."""
    match = re.fullmatch(r"([0-9]{1,6})[x×X]([0-9]{1,6})", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if min(width, height) < 1:
        raise ValueError(f"expected WIDTHxHEIGHT in px, each 1 to 999999, got {text!r}")
    return width, height


def _kinds(text: str) -> tuple[str, ...]:
    """Return the kinds of image in a list like ``rgb,depth``, each once."""
    kinds = tuple(dict.fromkeys(text.split(",")))
    if not set(kinds) <= set(IMAGE_KINDS):
        expected = f"{', '.join(IMAGE_KINDS)}, or several with commas"
        raise ValueError(f"expected {expected}, got {text!r}")
    return kinds


def _color(text: str) -> tuple[float, ...]:
    """Return the RGB values of a colour like ``1,0.5,0``."""
    parts = text.split(",")
    good = len(parts) == 3 and all(re.fullmatch(f"[+]?{_NUMBER}", p) for p in parts)
    if not good or not all(float(part) <= 1 for part in parts):
        raise ValueError(f"expected R,G,B, each from 0 to 1, got {text!r}")
    return tuple(map(float, parts))


def parse_budget(text: str) -> float:
    """Return the error in a text like ``1/255``; raise `ValueError` outside (0, 1)."""
    match = re.fullmatch(rf"({_NUMBER})(?:/({_NUMBER}))?", text)
    parts = [float(part or 1) for part in match.groups()] if match else [0.0]
    if min(parts) <= 0 or parts[0] >= parts[1]:
        raise ValueError(f"expected above 0 and below 1, like 1/255, got {text!r}")
    return parts[0] / parts[1]


def _times(text: str) -> tuple[float, float]:
    """Return the times of a text like ``0.4`` or ``0:1``; a single one twice."""
    parts = text.split(":")
    good = len(parts) in (1, 2) and all(re.fullmatch(_NUMBER, p) for p in parts)
    times = [float(part) for part in parts] if good else [-1.0]
    if not all(0 <= time <= 1 for time in times):
        expected = "a time from 0 to 1, or two like 0:1"
        raise ValueError(f"expected {expected}, got {text!r}")
    return times[0], times[-1]


Times = Annotated[tuple[float, float] | None, option("T|T0:T1", _times)]
Size = Annotated[tuple[int, int], option("WxH", _size, "{0[0]}x{0[1]}".format)]
OptionalSize = Annotated[tuple[int, int] | None, option("WxH", _size)]
Kinds = Annotated[tuple[str, ...], option("KINDS", _kinds, ",".join)]
Color = Annotated[tuple[float, ...] | None, option("R,G,B", _color)]
Budget = Annotated[float | None, option("ERROR", parse_budget)]


def _default_hint(shown: str) -> str:
    return "" if shown in ("", "None", "False") else f"(default: {shown})"


# Defaults of flags and optional values are explained in the help text, if at all.
WITH_DEFAULT = arg(help_behavior_hint=_default_hint)
