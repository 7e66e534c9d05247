"""Morton order: rows sorted along a curve that keeps neighbours in space together.

Formats that compress runs of rows gain from it; readers do not depend on it. Axis
legend: N rows.
"""

import numpy as np

_BITS = 10  # an axis
# A longer run of rows with one code is sorted again, within its own box.
_MAX_RUN = 256


def morton_order(means: np.ndarray) -> np.ndarray:
    """Return the order of rows by the Morton code of their positions.

    A code interleaves 10 bits an axis over the bounding box, the lowest bit that of x
    (Morton, "A Computer Oriented Geodetic Data Base", IBM 1966). Runs of more than 256
    rows with one code are sorted again within their own box. Rows with equal codes keep
    their order.

    Args:
      means: [N, 3] finite positions, in any unit.

    Returns:
      [N] int64: row ``order[i]`` of ``means`` is row i of the result.
    """
    # Half of each value: the extent of a box never overflows.
    halves = np.asarray(means, np.float64) / 2
    order = np.arange(len(halves))
    pending = [(0, len(halves))]
    while pending:
        start, end = pending.pop()
        rows = order[start:end]
        codes = _codes(halves[rows])
        by_code = np.argsort(codes, kind="stable")
        order[start:end] = rows[by_code]
        edges = np.flatnonzero(np.diff(codes[by_code], prepend=-1, append=-1))
        if len(edges) <= 2:  # one code: the box has no extent
            continue
        long = np.flatnonzero(np.diff(edges) > _MAX_RUN)
        pending += [(start + edges[i], start + edges[i + 1]) for i in long]
    return order


def _codes(positions: np.ndarray) -> np.ndarray:
    """Return the Morton codes [N] int64 of positions [N, 3] in their bounding box."""
    low = positions.min(axis=0, initial=np.inf)
    extent = positions.max(axis=0, initial=-np.inf) - low
    share = (positions - low) / np.where(extent > 0, extent, 1)
    cells = np.minimum(share * 2**_BITS, 2**_BITS - 1).astype(np.int64)
    codes = np.zeros(len(positions), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes
