"""Options that may be left out: how tyro reads them, and what its help says of them."""

from dataclasses import replace
from types import NoneType, UnionType
from typing import Union, get_args

from tyro.conf import arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

OPTIONAL = ConstructorRegistry()


@OPTIONAL.primitive_rule
def _left_out_or(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """``X | None`` is read as X: None is what it is when left out, not to be typed."""
    kinds = set(get_args(info.type)) - {NoneType}
    if info.type_origin not in (Union, UnionType) or len(kinds) != 1:
        return None
    inner = PrimitiveTypeInfo.make(kinds.pop(), info.markers)
    spec = ConstructorRegistry.get_primitive_spec(inner)
    assert isinstance(spec, PrimitiveConstructorSpec), f"{info.type} is no option"
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: (
            [] if value is None else spec.str_from_instance(value)
        ),
    )


def _default(shown: str) -> str:
    return "" if shown in ("", "False") else f"(default: {shown})"


# What is off or left open has its default in the words of its help, if anywhere.
TOLD = arg(help_behavior_hint=_default)
