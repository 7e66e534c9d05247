"""Photographs made smaller for the first steps of a training."""

import numpy as np
import pytest

from gsjax.data.types import Photo
from gsjax.train.frames import make_frames


def photo_of(pixels, alpha=None) -> Photo:
    K = np.asarray([[30.0, 0, 15.5], [0, 31, 12], [0, 0, 1]])
    return Photo(pixels, alpha, None, K)


def shrunk(photo, divisor, view) -> np.ndarray:
    return np.asarray(make_frames([view], [photo], divisor).pixels[0], np.float64)


@pytest.fixture
def view():
    from training import scene

    return scene().views[0]


def over(pixels, alpha, background):
    """[H, W, 3] of colours and opacities of 0 to 255 before a background."""
    share = np.asarray(alpha, np.float64)[..., None] / 255
    return share * pixels + (1 - share) * background


@pytest.mark.parametrize("divisor", [2, 4])
def test_a_smaller_photograph_looks_as_the_photograph_does_from_afar(divisor, view):
    """Before any background: averages of what is seen, not of what is stored."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (24, 32, 3)).astype(np.uint8)
    alpha = rng.choice(np.asarray([0, 0, 1, 90, 255, 255], np.uint8), (24, 32))
    alpha[:8, :8] = 0
    small = shrunk(photo_of(pixels, alpha), divisor, view)
    for background in (0.0, 255.0, 77.0):
        seen = over(pixels, alpha, background)
        blocks = seen.reshape(24 // divisor, divisor, 32 // divisor, divisor, 3)
        found = over(small[..., :3], small[..., 3], background)
        # Half a step of the colour, and half of one of the opacity.
        assert np.abs(found - blocks.mean(axis=(1, 3))).max() <= 1.0 + 1e-3


def test_colours_that_are_not_seen_do_not_matter(view):
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 256, (24, 32, 3)).astype(np.uint8)
    alpha = rng.choice(np.asarray([0, 128, 255], np.uint8), (24, 32))
    alpha[:8] = 0
    other = np.where(alpha[..., None] > 0, pixels, 255 - pixels)
    small = shrunk(photo_of(pixels, alpha), 2, view)
    np.testing.assert_array_equal(small, shrunk(photo_of(other, alpha), 2, view))
    assert (small[..., 3] == 0).any()
    assert (small[small[..., 3] == 0] == 0).all(), "black where nothing is"
    assert small.max() > 100


def test_one_that_is_opaque_is_averaged_as_one_without_opacity(view):
    pixels = np.random.default_rng(2).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    plain = shrunk(photo_of(pixels), 3, view)
    opaque = shrunk(photo_of(pixels, np.full((24, 32), 255, np.uint8)), 3, view)
    assert (opaque[..., 3] == 255).all()
    assert np.abs(opaque[..., :3] - plain).max() <= 1  # of rounding at halves


@pytest.mark.parametrize("divisor", [1, 2])
def test_opacity_is_kept_where_any_photograph_has_it(view, divisor):
    """The others are opaque; where none has it there is no such channel."""
    pixels = np.full((24, 32, 3), 90, np.uint8)
    clear = photo_of(pixels, np.full((24, 32), 60, np.uint8))
    both = make_frames([view, view], [photo_of(pixels), clear], divisor).pixels
    assert both.shape[-1] == 4
    assert (both[0, ..., 3] == 255).all()
    assert (both[1, ..., 3] == 60).all()
    assert make_frames([view], [photo_of(pixels)], divisor).pixels.shape[-1] == 3
