"""Weighted k-means and codebooks, compared with SciPy and with laws of the optimum."""

import numpy as np
import pytest
from captures import rejects
from scipy.cluster.vq import kmeans2

from gsjax.math.clustering import codebook, kmeans


def blobs(count: int, dims: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centers = 8 * rng.normal(size=(12, dims))
    spread = rng.normal(size=(count, dims)) * np.exp(rng.normal(size=(count, 1)))
    return (centers[rng.integers(0, 12, count)] + spread).astype(np.float32)


def distortion(points, clusters, weights=None) -> float:
    errors = np.sum((points - clusters.centroids[clusters.labels]) ** 2, 1)
    return float(np.average(errors, weights=weights))


def test_labels_are_nearest_and_distortion_is_that_of_scipy():
    points = blobs(1500, 9)
    found = kmeans(points, 40, iterations=20)
    squares = np.sum((points[:, None] - found.centroids) ** 2, -1)
    np.testing.assert_allclose(
        squares[np.arange(len(points)), found.labels], squares.min(1), rtol=1e-4
    )
    theirs = kmeans2(points, 40, iter=20, minit="++", seed=0)
    expected = np.mean(np.sum((points - theirs[0][theirs[1]]) ** 2, 1))
    assert distortion(points, found) < 1.1 * expected
    assert len(np.unique(found.labels)) == 40


def test_centroids_are_weighted_means():
    points, rng = blobs(600, 3), np.random.default_rng(1)
    weights = rng.exponential(size=600)
    found = kmeans(points, 8, weights=weights, iterations=200)
    for label in range(8):
        own = found.labels == label
        mean = np.average(points[own], weights=weights[own], axis=0)
        np.testing.assert_allclose(found.centroids[label], mean, atol=1e-3)


def test_weights_move_the_centroids():
    points = blobs(600, 3)
    weights = np.where(np.arange(600) < 60, 1e3, 1.0)
    heavy = kmeans(points, 30, weights=weights)
    light = kmeans(points, 30)
    assert distortion(points, heavy, weights) < 0.6 * distortion(points, light, weights)


def test_few_distinct_points_are_kept():
    points = np.repeat(blobs(50, 5), 7, axis=0)
    found = kmeans(points, 64)
    np.testing.assert_array_equal(found.centroids[found.labels], points)
    assert len(found.centroids) == 50


def test_many_clusters_are_made_within_groups():
    """More than 512, where points are first divided."""
    points = blobs(2000, 2)
    found = kmeans(points, 600, iterations=3)
    assert found.centroids.shape == (600, 2)
    assert found.labels.max() == 599
    assert len(np.unique(found.labels)) > 580
    fewer = kmeans(points, 500, iterations=3)
    assert distortion(points, found) < distortion(points, fewer)


def test_codebooks_are_optimal_levels():
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    table, indices = codebook(values, 16)
    assert (np.diff(table) > 0).all()
    np.testing.assert_array_equal(
        np.abs(values - table[indices]), np.abs(values[:, None] - table).min(1)
    )
    # The optimum of 16 levels for a normal distribution: Max 1960, table I.
    error = np.mean((values - table[indices]) ** 2) / np.var(values)
    assert error == pytest.approx(0.009497, rel=0.05)


def test_codebooks_keep_few_distinct_values():
    values = np.float32([3, -1.5, 3, 0.1, 1e-30])
    table, indices = codebook(values, 4)
    np.testing.assert_array_equal(table[indices], values)
    assert len(table) == 4
    table, indices = codebook(values[:1], 256)
    np.testing.assert_array_equal(table, np.full(256, 3, np.float32))
    assert len(codebook(values[:0], 8)[0]) == 8


def test_codebooks_follow_weights():
    values = np.linspace(-1, 1, 5001, dtype=np.float32)
    weights = np.where(values > 0.8, 1000.0, 1.0)
    error = np.abs(values - np.take(*codebook(values, 16, weights=weights)))
    assert error[values > 0.8].max() < error[values < 0].max() / 3


def test_nothing_to_cluster():
    rejects("at least one point", kmeans, np.zeros((0, 3)), 4)
    rejects("and 0 clusters", kmeans, np.zeros((3, 3)), 0)
