"""Settings of a training run as JSON, and values of JSON held against types."""

import json
import math
from dataclasses import asdict, fields
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.raster.types import RasterConfig
from gsjax.train.config import Level, TrainConfig
from gsjax.train.optimiser import Rates

_MAX_WHOLE = 1 << 63


def to_json(config: TrainConfig) -> str:
    """As text, for `config.json`."""
    return json.dumps(asdict(config), indent=2) + "\n"


def from_json(text: str) -> TrainConfig:
    """The settings in such a text.

    Raises:
      InputError: if it is not one, or of another version.
    """
    try:
        data = json.loads(text)
        if not isinstance(data, dict):
            raise ValueError(f"{repr(data)[:80]} is no object")
        unknown = set(data) - {f.name for f in fields(TrainConfig)}
        if unknown:
            raise ValueError(f"unknown settings {sorted(unknown)}")
        check_kinds(TrainConfig, data)
        if "rates" in data:  # a NamedTuple: a list in JSON
            rates = data["rates"]
            if len(rates) in (6, 7):  # of before there was a cooling, or from where
                rates = [*rates, *Rates()[len(rates) :]]
            check_kinds(Rates, dict(zip(Rates._fields, rates, strict=True)))
            data["rates"] = Rates(tuple(rates[0]), *rates[1:])
        for name, kind in (("adaptive", AdaptiveSettings), ("mcmc", McmcSettings)):
            if name in data:
                check_kinds(kind, data[name])
                data[name] = kind(**data[name])
        if "raster" in data:
            check_kinds(RasterConfig, data["raster"])
            outputs = tuple(data["raster"].pop("outputs", ("rgb",)))
            data["raster"] = RasterConfig(outputs=outputs, **data["raster"])
        if "levels" in data:
            for level in data["levels"]:
                check_kinds(Level, level)
            data["levels"] = tuple(Level(**level) for level in data["levels"])
        return TrainConfig(**data)
    except (
        *(ValueError, TypeError, KeyError, AttributeError, IndexError),
        RecursionError,
    ) as error:
        raise InputError(
            f"not the settings of a training run: {error}; train again, or use the "
            "version of gsjax that wrote them"
        ) from error


def check_kinds(kind: type, data: dict[str, Any]) -> None:
    """Hold JSON values against the types of a class's fields.

    Raises:
      ValueError: if one is of another type, or NaN.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{repr(data)[:80]} is no object")
    for name, hint in get_type_hints(kind).items():
        if name in data and not _is_kind(data[name], hint):
            told = getattr(hint, "__name__", str(hint))
            raise ValueError(f"{name} is {repr(data[name])[:80]}; {told} is wanted")


def _is_kind(value, hint) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_is_kind(value, argument) for argument in arguments)
    if origin is tuple:
        if not isinstance(value, list):
            return False
        if arguments[1:] == (...,):
            arguments = arguments[:1] * len(value)
        return len(value) == len(arguments) and all(map(_is_kind, value, arguments))
    if type(value) is int and abs(value) > _MAX_WHOLE:  # nor does float64 hold all
        return False
    if hint is float:
        return type(value) in (int, float) and not math.isnan(value)
    if hint is Path:
        return type(value) is str
    if hint in (int, str, bool, type(None)):
        return type(value) is hint
    return True  # made of fields that are held against their own types
