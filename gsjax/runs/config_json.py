"""Training settings as JSON, and JSON values checked against type annotations."""

import copy
import math
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.raster.types import RasterConfig
from gsjax.train.config import Level, TrainConfig
from gsjax.train.motion.settings import FieldSettings, TrajectorySettings
from gsjax.train.optimiser import Rates

_MAX_INTEGER = 1 << 63
# Settings that are dataclasses themselves.
_PARTS = {
    "adaptive": AdaptiveSettings,
    "mcmc": McmcSettings,
    "field": FieldSettings,
    "trajectories": TrajectorySettings,
}
_MALFORMED = (ValueError, TypeError, LookupError, AttributeError, RecursionError)


def config_from_json(data: Any) -> TrainConfig:
    """Return the settings of the JSON value of `dataclasses.asdict`.

    Raises:
      InputError: if it is malformed or of an incompatible version.
    """
    try:
        return _config(copy.deepcopy(data))
    except _MALFORMED as error:
        remedy = "train again, or use the version of gsjax that wrote them"
        raise InputError(f"not the settings of a run: {error}; {remedy}") from error


def _config(data: Any) -> TrainConfig:
    check_types(TrainConfig, data)
    unknown = set(data) - {f.name for f in fields(TrainConfig)}
    if unknown:
        raise ValueError(f"unknown settings {sorted(unknown)}")
    if "rates" in data:  # a NamedTuple: a list in JSON
        rates = data["rates"]
        if len(rates) in (6, 7):  # older versions had no cooling
            rates = [*rates, *Rates()[len(rates) :]]
        check_types(Rates, dict(zip(Rates._fields, rates, strict=True)))
        data["rates"] = Rates(tuple(rates[0]), *rates[1:])
    for name, kind in _PARTS.items():
        if name in data:
            check_types(kind, data[name])
            data[name] = kind(**data[name])
    if "raster" in data:
        raster = data["raster"]
        if "stop" in raster:  # its name in older runs
            raster["transmittance_min"] = raster.pop("stop")
        check_types(RasterConfig, raster)
        outputs = tuple(raster.pop("outputs", ("rgb",)))
        data["raster"] = RasterConfig(outputs=outputs, **raster)
    if "levels" in data:
        for level in data["levels"]:
            check_types(Level, level)
        data["levels"] = tuple(Level(**level) for level in data["levels"])
    return TrainConfig(**data)


def check_types(kind: type, data: dict[str, Any]) -> None:
    """Check a JSON object against the annotated fields of a class.

    Raises:
      ValueError: if it is no object, or a value has another type or is NaN.
    """
    if not isinstance(data, dict):
        raise ValueError(f"expected an object, got {repr(data)[:80]}")
    for name, hint in get_type_hints(kind).items():
        if name in data and not _has_type(data[name], hint):
            expected, found = (
                getattr(hint, "__name__", str(hint)),
                repr(data[name])[:80],
            )
            raise ValueError(f"{name}: expected {expected}, got {found}")


def _has_type(value, hint) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_has_type(value, argument) for argument in arguments)
    if origin is tuple:
        if not isinstance(value, list):
            return False
        if arguments[1:] == (...,):
            arguments = arguments[:1] * len(value)
        return len(value) == len(arguments) and all(map(_has_type, value, arguments))
    if type(value) is int and abs(value) > _MAX_INTEGER:  # float64 may overflow
        return False
    if hint is float:
        return type(value) in (int, float) and not math.isnan(value)
    if hint is Path:
        return type(value) is str
    if hint in (int, str, bool, type(None)):
        return type(value) is hint
    return True  # a class whose own fields are checked separately
