"""Rotated harmonics, compared with colours in rotated directions and with a table."""

import numpy as np
import pytest
from captures import rejects
from conftest import DATA
from scipy.spatial.transform import Rotation

from gsjax.math.sh import eval_sh
from gsjax.math.sh_rotation import rotate_sh, rotation_blocks

SEEDS = range(3)


def directions(count: int = 50) -> np.ndarray:
    found = np.random.default_rng(1).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def orthogonal(seed: int) -> np.ndarray:
    """Return a rotation; mirrored for odd seeds."""
    turn = Rotation.random(random_state=seed).as_matrix()
    return turn @ np.diag([1, 1, -1]) if seed % 2 else turn


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("seed", SEEDS)
def test_a_rotated_scene_has_the_same_colours(degree, seed):
    """The directions are rotated, or mirrored, with the scene."""
    sh = np.random.default_rng(seed).normal(size=(7, (degree + 1) ** 2, 3))
    turn, ways = orthogonal(seed), directions()
    found, expected = (
        np.asarray(eval_sh(coefficients[:, None], d[None]))
        for coefficients, d in ((rotate_sh(sh, turn), ways @ turn.T), (sh, ways))
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_rotations_compose():
    first, second = orthogonal(0), orthogonal(3)
    sh = np.random.default_rng(5).normal(size=(4, 25, 3))
    twice = rotate_sh(rotate_sh(sh, first), second)
    np.testing.assert_allclose(rotate_sh(sh, second @ first), twice, atol=1e-12)
    np.testing.assert_allclose(rotate_sh(twice, (second @ first).T), sh, atol=1e-12)


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, -1, -1), (-1, -1, 1), (1, 1, -1)])
def test_half_turns_and_mirrors_only_change_signs(signs):
    sh = np.random.default_rng(5).normal(size=(4, 25, 3)).astype(np.float32)
    found = rotate_sh(sh, np.diag(signs))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.abs(found), np.abs(sh))


def test_rotations_of_a_reference_table():
    path = DATA / "methods" / "sh_rotation.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is absent (../shared/data/methods)")
    with np.load(path, allow_pickle=False) as table:
        for turn, expected in zip(table["rotations"], table["D"]):
            for l, block in enumerate(rotation_blocks(4, turn)):
                band = slice(l * l, (l + 1) ** 2)
                np.testing.assert_allclose(block, expected[band, band], atol=1e-12)


@pytest.mark.parametrize(
    "matrix", [2 * np.eye(3), np.eye(4), np.full((3, 3), np.nan), np.ones((3, 3))]
)
def test_other_matrices_are_rejected(matrix):
    rejects("rotation: expected an orthogonal matrix", rotation_blocks, 1, matrix)
