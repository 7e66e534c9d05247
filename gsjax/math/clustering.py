"""Vector and scalar quantisation: weighted k-means, and codebooks of numbers.

Axis legend: N points, D dimensions, C clusters, M numbers.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.errors import InputError
from gsjax.math.levels import optimal_levels

Array = jax.Array

_CHUNK = 2048  # points whose distances to all centroids are held at a time
_MAX_FLAT = 512  # clusters from which points are first divided into groups
_PER_GROUP = 256  # clusters of a group, on average
_IN_GROUP = 4  # iterations within a group
_SAMPLED = 4  # points per cluster among which the first centroids are chosen
_LLOYD_STEPS = 40


class Clusters(NamedTuple):
    """Result of `kmeans`.

    Attributes:
      centroids: [C, D] float32.
      labels: [N] int32, the centroid of each point.
    """

    centroids: np.ndarray
    labels: np.ndarray


def kmeans(
    points: np.ndarray,
    count: int,
    *,
    weights: np.ndarray | None = None,
    iterations: int = 10,
    seed: int = 0,
) -> Clusters:
    """Return centroids that reduce the weighted squared distance to the points.

    Lloyd's iterations from a sample of distant points; a cluster that loses all points
    moves to the point with the largest weighted error. If there are at most ``count``
    distinct points, they are the centroids, and nothing is lost. For more than 512
    clusters the points are first divided into groups, which are clustered one by one.

    Lloyd, "Least squares quantization in PCM", IEEE Trans. Inf. Theory, 1982.

    Args:
      points: [N, D] finite numbers.
      count: largest number of clusters.
      weights: [N] numbers of at least 0; None for equal weights.
      iterations: number of Lloyd's iterations.
      seed: seed of the sample.

    Returns:
      C = min(count, distinct points) clusters.

    Raises:
      InputError: if there is no point, or ``count`` is below 1.
    """
    points = np.asarray(points, np.float32)
    if not len(points) or count < 1:
        what = f"got {len(points)} points and {count} clusters"
        raise InputError(f"points: expected at least one point and cluster, {what}")
    found, labels = np.unique(points, axis=0, return_inverse=True)
    labels = labels.reshape(-1).astype(np.int32)
    if len(found) <= count:
        return Clusters(found, labels)
    total = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    mass = np.bincount(labels, total, minlength=len(found))
    mass = np.maximum(mass / max(mass.max(), 1e-300), 1e-12).astype(np.float32)
    rng = np.random.default_rng(seed)
    clusters = _cluster(found, mass, count, iterations, rng)
    return Clusters(clusters.centroids, clusters.labels[labels])


def _cluster(points, mass, count: int, iterations: int, rng) -> Clusters:
    """Cluster distinct points [N, D] with positive weights [N]."""
    if count >= len(points):
        return Clusters(points, np.arange(len(points), dtype=np.int32))
    way = _flat if count <= _MAX_FLAT else _grouped
    return way(points, mass, count, iterations, rng)


def _flat(points, mass, count: int, iterations: int, rng) -> Clusters:
    """Cluster all points at once."""
    # Sizes are padded to powers of two, so that few programs are compiled.
    rows, slots = _bucket(len(points)), _bucket(count)
    padded = np.zeros((rows, points.shape[1]), np.float32)
    padded[: len(points)] = points
    weight = np.zeros(rows, np.float32)
    weight[: len(points)] = mass
    start = np.full((slots, points.shape[1]), np.inf, np.float32)
    start[:count] = _spread_sample(points, mass, count, rng)
    centroids, labels = _lloyd(padded, weight, start, count, iterations)
    return Clusters(np.asarray(centroids)[:count], np.asarray(labels)[: len(points)])


def _spread_sample(points, mass, count: int, rng) -> np.ndarray:
    """Return [count, D] points, each far from those before it.

    k-means++ (Arthur and Vassilvitskii 2007) on a sample of the points.
    """
    size = min(len(points), _SAMPLED * count)
    some = points[rng.choice(len(points), size, replace=False, p=mass / mass.sum())]
    norms, chosen = np.sum(np.square(some), 1), np.zeros(count, int)
    squares = np.full(size, np.inf, np.float32)
    for place in range(count - 1):
        last = chosen[place]
        distance = norms + norms[last] - 2 * (some @ some[last])
        squares = np.minimum(squares, np.maximum(distance, 0))
        squares[last] = 0
        heights = np.cumsum(squares, dtype=np.float64)
        level = rng.uniform(0, heights[-1])
        chosen[place + 1] = min(np.searchsorted(heights, level), size - 1)
    return some[chosen]


def _bucket(size: int) -> int:
    return 1 << max(size - 1, 1).bit_length()


def _grouped(points, mass, count: int, iterations: int, rng) -> Clusters:
    """Cluster within groups, whose numbers of clusters follow their numbers of points.

    Far fewer distances are computed than for all clusters at once.
    """
    groups = -(-count // _PER_GROUP)
    coarse = _flat(points, mass, groups, iterations, rng).labels
    sizes = np.bincount(coarse, minlength=groups)
    shares = _shares(sizes, count)
    labels, centroids, start = np.zeros(len(points), np.int32), [], 0
    for group in np.flatnonzero(sizes):
        rows = np.flatnonzero(coarse == group)
        some, share = points[rows], int(shares[group])
        found = _cluster(some, mass[rows], share, min(iterations, _IN_GROUP), rng)
        centroids.append(found.centroids)
        labels[rows] = start + found.labels
        start += len(found.centroids)
    return Clusters(np.concatenate(centroids), labels)


def _shares(sizes: np.ndarray, count: int) -> np.ndarray:
    """Divide ``count`` clusters among groups by size: at least 1, at most the size."""
    filled = sizes > 0
    ideal = np.where(filled, 1 + (count - filled.sum()) * sizes / sizes.sum(), 0)
    shares = np.minimum(np.floor(ideal).astype(int), sizes)
    spare = np.argsort(-(ideal - shares), kind="stable")
    while (missing := count - shares.sum()) > 0:
        open_groups = spare[(shares < sizes)[spare]][:missing]
        shares[open_groups] += 1
    return shares


@partial(jax.jit, static_argnums=4)
def _lloyd(points, weight, centroids, count, iterations: int):
    """Return centroids and labels after Lloyd's iterations.

    Args:
      points: [N, D]; padding has weight 0.
      weight: [N] weights.
      centroids: [C, D] start; padding is infinite, so that no point is nearest to it.
      count: [] number of centroids that are not padding.
      iterations: number of iterations.
    """
    slots = jnp.arange(len(centroids))

    def step(_, centroids):
        labels, error = _nearest(points, centroids)
        mass = jnp.zeros(len(centroids), weight.dtype).at[labels].add(weight)
        sums = jnp.zeros_like(points, shape=centroids.shape)
        sums = sums.at[labels].add(weight[:, None] * points)
        means = sums / jnp.where(mass > 0, mass, 1)[:, None]
        # Empty clusters take the points that are approximated worst, one each.
        empty = (mass <= 0) & (slots < count)
        rank = jnp.cumsum(empty) - 1
        worst = lax.top_k(weight * error, min(len(centroids), len(points)))[1]
        moved = points[worst[jnp.clip(rank, 0, len(worst) - 1)]]
        means = jnp.where(empty[:, None], moved, means)
        return jnp.where((slots < count)[:, None], means, centroids)

    centroids = lax.fori_loop(0, iterations, step, centroids)
    return centroids, _nearest(points, centroids)[0]


def _nearest(points: Array, centroids: Array) -> tuple[Array, Array]:
    """Return the nearest centroid [N] of each point, and the squared distance [N]."""
    finite = jnp.isfinite(centroids[:, 0])
    centroids = jnp.where(finite[:, None], centroids, 0)
    norms = jnp.where(finite, jnp.sum(jnp.square(centroids), 1), jnp.inf)

    def of_chunk(chunk):
        product = jnp.matmul(chunk, centroids.T, precision="highest")
        scores = norms - 2 * product
        label = jnp.argmin(scores, 1).astype(jnp.int32)
        offset = chunk - centroids[label]
        return label, jnp.sum(jnp.square(offset), 1)

    size = min(_CHUNK, len(points))
    chunks = points.reshape(-1, size, points.shape[1])
    labels, errors = lax.map(of_chunk, chunks)
    return labels.reshape(-1), errors.reshape(-1)


def nearest_by_cost(
    points: np.ndarray, centroids: np.ndarray, weights: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """Return the labels [N] that minimise weight · squared distance + cost.

    Args:
      points: [N, D].
      centroids: [C, D].
      weights: [N] of each point.
      costs: [C] of each centroid.
    """
    rows, slots = _bucket(len(points)), _bucket(len(centroids))
    padded = np.zeros((rows, points.shape[1]), np.float32)
    padded[: len(points)] = points
    weight = np.zeros(rows, np.float32)
    # Only the ratio to the costs counts; weights of about 1 keep all digits.
    unit = float(np.max(weights, initial=0)) or 1.0
    weight[: len(points)] = weights / unit
    table = np.zeros((slots, points.shape[1]), np.float32)
    table[: len(centroids)] = centroids
    cost = np.full(slots, np.inf, np.float32)
    cost[: len(costs)] = costs / unit
    return np.asarray(_least_cost(padded, table, weight, cost))[: len(points)]


@jax.jit
def _least_cost(points: Array, centroids: Array, weights: Array, costs: Array) -> Array:
    norms = jnp.sum(jnp.square(centroids), 1)

    def of_chunk(inputs):
        chunk, weight = inputs
        product = jnp.matmul(chunk, centroids.T, precision="highest")
        scores = weight[:, None] * (norms - 2 * product) + costs
        return jnp.argmin(scores, 1).astype(jnp.int32)

    size = min(_CHUNK, len(points))
    chunks = points.reshape(-1, size, points.shape[1]), weights.reshape(-1, size)
    return lax.map(of_chunk, chunks).reshape(-1)


def codebook(
    values: np.ndarray, count: int, *, weights: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a table of numbers that approximates values, and an index for each.

    The table is exact if there are at most ``count`` distinct values. Otherwise it is
    that of `gsjax.math.levels.optimal_levels`, refined by Lloyd's iterations.

    Args:
      values: [M] finite numbers; M may be 0.
      count: length of the table.
      weights: [M] numbers of at least 0; None for equal weights.

    Returns:
      The table [count] float32, ascending, padded with its last entry; and the indices
      [M] int32.
    """
    values = np.asarray(values, np.float32).ravel()
    found, indices = np.unique(values, return_inverse=True)
    indices = indices.reshape(-1).astype(np.int32)
    if len(found) <= count:
        entries = found if len(found) else np.zeros(1, np.float32)
        return np.pad(entries, (0, count - len(entries)), mode="edge"), indices
    mass = np.bincount(indices, weights, minlength=len(found)).astype(np.float64)
    mass += mass.sum() * 1e-9 / len(found)
    entries = _levels(found.astype(np.float64), mass, count).astype(np.float32)
    middles = (entries[1:] + entries[:-1]) / 2
    return entries, np.searchsorted(middles, found).astype(np.int32)[indices]


def _levels(found: np.ndarray, mass: np.ndarray, count: int) -> np.ndarray:
    """Return [count] ascending levels for ascending values [M] with weights [M]."""
    levels = optimal_levels(found, mass, count)
    zero = np.zeros(1)
    sums = np.concatenate([zero, np.cumsum(mass)])
    moments = np.concatenate([zero, np.cumsum(mass * found)])
    for _ in range(_LLOYD_STEPS):
        middles = (levels[1:] + levels[:-1]) / 2
        ends = np.searchsorted(found, middles)
        ends = np.concatenate([[0], ends, [len(found)]])
        inside = np.diff(sums[ends])
        means = np.diff(moments[ends]) / np.where(inside > 0, inside, 1)
        levels = np.sort(np.where(inside > 0, means, levels))
    return levels
