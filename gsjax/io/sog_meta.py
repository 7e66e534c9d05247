"""The meta.json of a SOG scene, version 1 or 2: tables of the values of bytes."""

import json
import math
from typing import Any, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io.common import byte_logits
from gsjax.io.sog_files import META, REMEDY, SogFiles, checked_name
from gsjax.math.sh import num_bases
from gsjax.runtime.files import shown

ENTRIES = 256  # of a codebook: an index is a byte
PALETTE_COLUMNS = 64  # entries of the palette in a row of its texture
MAX_PALETTE = 1 << 16  # an index is two bytes
MAX_DEGREE = 3
MODELS = {"mip": "antialiased", "2dgs": "2dgs"}  # by render mode
_MAX_COUNT = 1 << 28  # of the largest texture
_MAX_VALUE = float(np.finfo(np.float32).max)


class Harmonics(NamedTuple):
    """Coefficients of degree 1 and above: a palette, and an index of each Gaussian.

    Attributes:
      files: names of the textures of the palette and of the indices.
      values: [256] float32, the coefficient that each byte stands for.
      degree: SH degree; None in version 1, where the palette's width tells it.
      entries: number of entries of the palette; None in version 1.
    """

    files: tuple[str, str]
    values: np.ndarray
    degree: int | None
    entries: int | None


class Meta(NamedTuple):
    """Contents of a meta.json.

    Attributes:
      gaussians: number of Gaussians.
      mode: render mode, see `gsjax.io.formats.render_mode`.
      files: names of the textures by role: means_l, means_u, quats, scales, sh0.
      mins, maxs: [3] bounds of sign(x) ln(1 + |x|) of the means x.
      scales: [3, 256] float32, log scales of each byte, by axis. Bytes beyond a short
        codebook stand for NaN, here and below.
      colors: [3, 256] float32, SH coefficients of degree 0, by channel.
      opacities: [256] float32 logits.
      harmonics: or None for SH degree 0.
    """

    gaussians: int
    mode: str | None
    files: dict[str, str]
    mins: np.ndarray
    maxs: np.ndarray
    scales: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray
    harmonics: Harmonics | None

    def names(self) -> list[str]:
        """Return the names of all textures."""
        extra = self.harmonics.files if self.harmonics else ()
        return [*self.files.values(), *extra]


def read_meta(files: SogFiles) -> Meta:
    """Parse and check the meta.json of a scene.

    Raises:
      InputError: if it is missing, is not JSON, has another version, lacks a field, or
        has a field that is not finite or out of range.
    """
    where, text = files.where(META), files.read(META)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        what = f"not JSON: {str(error)[:120]}"
        raise InputError(f"{where}: {what}; {REMEDY}") from error
    fields = _Fields(where, data)
    version = fields.get("version", default=1)
    if isinstance(version, bool) or version not in (1, 2):
        remedy = "export it again as version 2"
        raise InputError(
            f"{where}: expected version 2, or none as in version 1, got "
            f"{shown(version)}; {remedy}"
        )
    old = version == 1
    key = "means.shape" if old else "count"
    count = fields.get(key)
    if old:
        count = count[0] if isinstance(count, list) and count else None
    lower, upper = fields.names("means", 2)
    roles = {"means_l": lower, "means_u": upper}
    roles |= {role: fields.names(role, 1)[0] for role in ("quats", "scales", "sh0")}
    scales, colors, opacities = _ranges(fields) if old else _codebooks(fields)
    return Meta(
        gaussians=fields.whole(key, count, 0, _MAX_COUNT),
        mode=_mode(fields),
        files=roles,
        mins=fields.numbers("means.mins", 3),
        maxs=fields.numbers("means.maxs", 3),
        scales=scales,
        colors=colors,
        opacities=opacities,
        harmonics=_harmonics(fields, old) if fields.get("shN", default=None) else None,
    )


class _Fields(NamedTuple):
    """Checked access to a parsed meta.json."""

    where: str
    data: Any

    def fault(self, key: str, expected: str, got: Any) -> InputError:
        return InputError(
            f"{self.where}: {key}: expected {expected}, got {shown(got)}; {REMEDY}"
        )

    def get(self, key: str, **default) -> Any:
        """Return the value at a dotted path, or ``default`` if it is missing."""
        value = self.data
        for name in key.split("."):
            if not isinstance(value, dict) or (name not in value and not default):
                raise self.fault(key, f"an object with {name!r}", value)
            value = value.get(name, default.get("default"))
        return value

    def whole(self, key: str, value: Any, least: int, most: int) -> int:
        """Return a whole number within bounds."""
        if type(value) is not int or not least <= value <= most:
            raise self.fault(key, f"a whole number from {least} to {most:,}", value)
        return value

    def numbers(self, key: str, least: int, most: int | None = None) -> np.ndarray:
        """Return a list of finite numbers, of length ``least`` to ``most``, float64."""
        value, most = self.get(key), most or least
        numeric = isinstance(value, list) and {*map(type, value)} <= {int, float}
        if numeric and least <= len(value) <= most:
            # Whole numbers may exceed float64; values are used as float32.
            found = [v if abs(v) <= _MAX_VALUE else math.nan for v in value]
            if not any(map(math.isnan, found)):
                return np.asarray(found, np.float64)
        number = f"{least}" if least == most else f"{least} to {most}"
        raise self.fault(key, f"{number} finite numbers", value)

    def names(self, key: str, count: int) -> list[str]:
        """Return the names of the textures of a property."""
        value = self.get(f"{key}.files")
        listed = value if isinstance(value, list) else []
        names = [name for name in listed if isinstance(name, str)]
        if len(names) < count or len(names) != len(listed):
            raise self.fault(f"{key}.files", f"{count} names of files", value)
        return [checked_name(f"{self.where}: {key}.files", n) for n in names[:count]]


def _mode(fields: _Fields) -> str | None:
    model = fields.get("model", default=None)
    for mode, known in MODELS.items():
        if model == known:
            return mode
    # As early descriptions of the format spell it.
    return "mip" if fields.get("antialias", default=None) is True else None


def _codebooks(fields: _Fields) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tables of scales, colours and opacities of version 2."""
    scales, colors = (_codebook(fields, key) for key in ("scales", "sh0"))
    logits = byte_logits(np.arange(ENTRIES))
    return np.tile(scales, (3, 1)), np.tile(colors, (3, 1)), logits


def _codebook(fields: _Fields, key: str) -> np.ndarray:
    found = fields.numbers(f"{key}.codebook", 1, ENTRIES)
    table = np.full(ENTRIES, np.nan, np.float32)
    table[: len(found)] = found
    return table


def _ranges(fields: _Fields) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tables of scales, colours and opacities of version 1."""
    scales, colors = (_range(fields, key, n) for key, n in (("scales", 3), ("sh0", 4)))
    return scales, colors[:3], colors[3]


def _range(fields: _Fields, key: str, channels: int) -> np.ndarray:
    low = fields.numbers(f"{key}.mins", channels)[:, None]
    high = fields.numbers(f"{key}.maxs", channels)[:, None]
    share = np.linspace(0, 1, ENTRIES)
    return (low * (1 - share) + high * share).astype(np.float32)


def _harmonics(fields: _Fields, old: bool) -> Harmonics:
    palette, labels = fields.names("shN", 2)
    if old:
        bounds = [fields.get(f"shN.{name}") for name in ("mins", "maxs")]
        pair = _Fields(fields.where, {"shN": {"bounds": bounds}})
        low, high = pair.numbers("shN.bounds", 2)
        values = np.linspace(low, high, ENTRIES).astype(np.float32)
        return Harmonics((palette, labels), values, None, None)
    degree = fields.whole("shN.bands", fields.get("shN.bands"), 1, MAX_DEGREE)
    count = fields.whole("shN.count", fields.get("shN.count"), 1, MAX_PALETTE)
    return Harmonics((palette, labels), _codebook(fields, "shN"), degree, count)


def degree_of_width(width: int) -> int | None:
    """Return the SH degree of a palette by the width of its texture, in px."""
    for degree in range(1, MAX_DEGREE + 1):
        if width == PALETTE_COLUMNS * (num_bases(degree) - 1):
            return degree
    return None


def palette_height(count: int) -> int:
    """Return the height in px of the texture of a palette of ``count`` entries."""
    return math.ceil(count / PALETTE_COLUMNS)
