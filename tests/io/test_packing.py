"""Morton order, and quaternions packed without a component, against plain loops."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.io.morton import morton_order
from gsjax.io.packed_quats import (
    PackedQuats,
    join_words,
    pack_quats,
    split_words,
    unpack_quats,
)


def interleaved(cell) -> int:
    """The Morton code of whole numbers x, y, z, by characters."""
    digits = zip(*(f"{c:010b}" for c in reversed(cell)))
    return int("".join("".join(three) for three in digits), 2)


def cells(count: int, seed: int) -> np.ndarray:
    """Whole numbers of 0 to 1023, with both ends on each axis."""
    found = np.random.default_rng(seed).integers(0, 1024, (count, 3))
    found[0], found[1] = 0, 1023
    return found


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_sorted_by_interleaved_cells(seed):
    found = cells(200, seed)
    # The middles of the cells of a box that is 1024 cells wide.
    means = np.concatenate([found + 0.5, [[0, 0, 0], [1024] * 3]])
    expected = [interleaved(cell) for cell in found]
    order = [row for row in morton_order(means) if row < len(found)]
    assert [expected[row] for row in order] == sorted(expected)
    assert sorted(order) == list(range(len(found)))


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([2.0**-30, 1.0, 2.0**1000]))
def test_order_does_not_depend_on_place_and_size(seed, size):
    rng = np.random.default_rng(seed)
    means = np.round(1024 * rng.normal(size=(300, 3)))  # sums are exact
    order = morton_order(means)
    assert sorted(order) == list(range(300))
    np.testing.assert_array_equal(morton_order(means * size), order)
    np.testing.assert_array_equal(morton_order(means + 2.0**20), order)


def test_a_crowded_cell_is_sorted_within_its_own_box():
    """A run of 256 rows is not, and neither are rows at one place."""
    rng = np.random.default_rng(0)
    for count in (256, 257):
        crowd = 5.005 + 1e-4 * rng.normal(size=(count, 3))  # in one cell
        means = np.concatenate([crowd, [[0, 0, 0], [10, 10, 10]]])
        order = morton_order(means)
        inner = order[order < count]
        own = morton_order(crowd) if count > 256 else np.arange(count)
        np.testing.assert_array_equal(inner, own)
    for means in (np.ones((1000, 3)), np.zeros((0, 3)), np.ones((1, 3))):
        np.testing.assert_array_equal(morton_order(means), np.arange(len(means)))
    # Boxes within boxes, down to the smallest numbers: must end.
    deep = np.repeat(2.0 ** -np.arange(0, 1074, 12.0), 300)[:, None] * np.ones(3)
    assert sorted(morton_order(deep)) == list(range(len(deep)))


def quaternions(count: int, seed: int) -> np.ndarray:
    """Unit quaternions, a third of them with components that are nearly equal."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    ties = rng.choice([-1.0, 0, 1], (count // 3, 4)) + 1e-3 * rng.normal(
        size=(count // 3, 4)
    )
    quats[: len(ties)] = ties
    quats[:4] = np.eye(4)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


@pytest.mark.parametrize(("levels", "degrees"), [(1022, 0.25), (1023, 0.25), (255, 1)])
def test_packed_quaternions_are_near_and_stay(levels, degrees, report):
    quats = quaternions(20_000, levels)
    packed = pack_quats(quats, levels)
    assert packed.codes.min() >= 0
    assert packed.codes.max() <= levels
    found = unpack_quats(packed, levels)
    turns = Rotation.from_quat(found) * Rotation.from_quat(quats).inv()
    report(f"degrees at {levels}", np.degrees(turns.magnitude()).max(), degrees)
    assert np.degrees(turns.magnitude()).max() < degrees
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-12)
    # As they come back from a scene of float32, and with the other sign.
    again = found.astype(np.float32).astype(np.float64)
    again /= np.linalg.norm(again, axis=1, keepdims=True)
    for same in (again, -again):
        for one, other in zip(pack_quats(same, levels), packed):
            np.testing.assert_array_equal(one, other)


def test_of_distinct_components_the_largest_is_dropped():
    quats = np.asarray([[0.9, -0.3, 0.2, -0.1], [0.1, -0.2, -0.9, 0.3]])
    dropped, codes = pack_quats(quats / np.linalg.norm(quats, axis=1)[:, None], 1023)
    assert dropped.tolist() == [0, 2]
    kept = np.asarray([[-0.3, 0.2, -0.1], [-0.1, 0.2, -0.3]]) / np.sqrt(0.95)
    np.testing.assert_array_equal(codes, np.rint((kept / np.sqrt(2) + 0.5) * 1023))


@given(st.lists(st.integers(0, 2**32 - 1), max_size=50))
def test_words_are_split_and_joined(words):
    packed = split_words(np.asarray(words, np.uint32))
    assert join_words(packed).tolist() == words
    for word, dropped, codes in zip(words, *packed):
        text = f"{word:032b}"
        parts = [text[:2], text[2:12], text[12:22], text[22:]]
        assert [dropped, *codes] == [int(part, 2) for part in parts]


def test_words_that_exceed_the_unit_norm_are_read():
    packed = PackedQuats(np.asarray([3]), np.asarray([[1023, 1023, 0]]))
    half = np.sqrt(0.5)
    found = unpack_quats(packed, 1023)
    np.testing.assert_allclose(found, [[half, half, -half, 0]], rtol=1e-12)
