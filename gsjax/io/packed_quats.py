"""Rotations as the three smallest components of a quaternion, in a few bits each.

A unit quaternion is stored without one component, the largest up to rounding, whose
sign is made positive: q and -q are one rotation. The others lie within ±√½ and become
whole numbers u from 0 to ``levels``, with value (u / levels - ½) √2. The order of the
components, wxyz or xyzw, is that of the format.
"""

import math
from typing import NamedTuple

import numpy as np

_BITS = 10  # of each number in a word of 32
# Rounding may exchange components that differ by less than this number of steps.
_TIE = 3
_NOISE = 2e-7  # of components in float32


class PackedQuats(NamedTuple):
    """Rotations in whole numbers.

    Attributes:
      dropped: [N] int64, index of the component that is not stored.
      codes: [N, 3] int64 of 0 to ``levels``, the others in the order of their indices.
    """

    dropped: np.ndarray
    codes: np.ndarray


def pack_quats(quats: np.ndarray, levels: int) -> PackedQuats:
    """Return unit quaternions rounded to the nearest whole numbers.

    Of components that are equally large up to rounding, the one whose absence moves the
    rotation least is dropped. Hence quaternions that were read from a file are packed
    to the bits of the file again.

    Args:
      quats: [N, 4] unit quaternions; either order of the components.
      levels: the greatest whole number, for example 1023 for 10 bits.
    """
    quats = np.asarray(quats, np.float64)
    sizes = np.abs(quats)
    largest = sizes.argmax(axis=1)
    packed = _without(quats, largest, levels)
    tie = _TIE * math.sqrt(2) / levels
    near = sizes >= sizes.max(axis=1, keepdims=True) - 2 * tie
    tied = np.flatnonzero(near.sum(axis=1) > 1)
    if not len(tied):
        return packed
    some, errors = quats[tied], []
    candidates = [_without(some, np.full(len(tied), k), levels) for k in range(4)]
    for index, candidate in enumerate(candidates):
        signed = some * np.where(some[:, index] < 0, -1, 1)[:, None]
        found = unpack_quats(candidate, levels)
        error = np.abs(found - signed).max(axis=1)
        # Only what is a tie as read too, or packing again would drop another one.
        valid = found[:, index] >= np.abs(found).max(axis=1) - tie
        errors.append(np.where(valid, error, np.inf))
    # Values may come from float32: differences below its precision are ties, and the
    # first index wins those.
    errors = np.round(np.stack(errors, axis=1) / _NOISE)
    best = errors.argmin(axis=1)
    packed.dropped[tied] = best
    codes = np.stack([candidate.codes for candidate in candidates])
    packed.codes[tied] = codes[best, np.arange(len(tied))]
    return packed


def _without(quats: np.ndarray, dropped: np.ndarray, levels: int) -> PackedQuats:
    """Pack quaternions [N, 4] without the components at ``dropped`` [N]."""
    positive = np.take_along_axis(quats, dropped[:, None], axis=1) >= 0
    others = np.take_along_axis(quats, _others(dropped), axis=1)
    others = np.where(positive, others, -others)
    codes = np.rint((others / math.sqrt(2) + 0.5) * levels)
    return PackedQuats(dropped, np.clip(codes, 0, levels).astype(np.int64))


def unpack_quats(packed: PackedQuats, levels: int) -> np.ndarray:
    """Return the quaternions [N, 4] of `pack_quats`, float64.

    They have unit norm unless the stored components exceed it, as in damaged files.
    """
    others = (packed.codes / levels - 0.5) * math.sqrt(2)
    rest = np.sqrt(np.maximum(0, 1 - np.sum(others**2, axis=1)))
    quats = np.zeros((len(others), 4))
    np.put_along_axis(quats, _others(packed.dropped), others, axis=1)
    np.put_along_axis(quats, packed.dropped[:, None], rest[:, None], axis=1)
    return quats


def _others(dropped: np.ndarray) -> np.ndarray:
    """Return the indices [N, 3] of the components that are stored, rising."""
    table = np.asarray([[k for k in range(4) if k != d] for d in range(4)])
    return table[dropped]


def join_words(packed: PackedQuats) -> np.ndarray:
    """Return words [N] uint32: the index in the 2 highest bits, then 10 bits a code."""
    words = packed.dropped.astype(np.uint32)
    for code in packed.codes.T:
        words = (words << _BITS) | code.astype(np.uint32)
    return words


def split_words(words: np.ndarray) -> PackedQuats:
    """Return the index and codes of words [N] uint32; inverts `join_words`."""
    words = np.asarray(words, np.int64)
    shifts = _BITS * np.arange(2, -1, -1)
    codes = words[:, None] >> shifts & (1 << _BITS) - 1
    return PackedQuats(words >> 3 * _BITS, codes)
