"""Laws of downscaled photographs and of the order of views."""

import numpy as np
import pytest
from training import dataset

from gsjax.data.types import Photo
from gsjax.train.frames import make_frames, views_of_step

VIEW = dataset().views[0]
PIXELS = np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.uint8)


def photo_of(pixels, alpha=None) -> Photo:
    K = np.asarray([[30.0, 0, 15.5], [0, 31, 12], [0, 0, 1]])
    return Photo(pixels, alpha, None, K)


def shrunk(photo, divisor) -> np.ndarray:
    return np.asarray(make_frames([VIEW], [photo], divisor).pixels[0], np.float64)


def over(pixels, alpha, background):
    """Return colours [H, W, 3] over a background; all values are 0 to 255."""
    share = np.asarray(alpha, np.float64)[..., None] / 255
    return share * pixels + (1 - share) * background


@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize("divisor", [2, 4])
def test_downscaling_averages_the_image_over_any_background(divisor, transparent):
    rng = np.random.default_rng(0)
    alpha = rng.choice(np.asarray([0, 0, 1, 90, 255, 255], np.uint8), (24, 32))
    alpha[:8, :8] = 0  # where colours have no effect
    alpha = alpha if transparent else np.full((24, 32), 255, np.uint8)
    small = shrunk(photo_of(PIXELS, alpha), divisor)
    if not transparent:
        plain = shrunk(photo_of(PIXELS), divisor)
        assert (small[..., 3] == 255).all()
        assert np.abs(small[..., :3] - plain).max() <= 1
    for background in (0.0, 255.0, 77.0):
        seen = over(PIXELS, alpha, background)
        blocks = seen.reshape(24 // divisor, divisor, 32 // divisor, divisor, 3)
        found = over(small[..., :3], small[..., 3], background)
        # Rounding of colour and opacity.
        assert np.abs(found - blocks.mean(axis=(1, 3))).max() <= 1.0 + 1e-3


@pytest.mark.parametrize("divisor", [1, 2])
def test_the_opacity_channel_is_added_if_any_photograph_has_one(divisor):
    plain = photo_of(PIXELS)
    clear = photo_of(PIXELS, np.full((24, 32), 60, np.uint8))
    both = make_frames([VIEW] * 2, [plain, clear], divisor).pixels
    assert both.shape[-1] == 4
    assert (both[0, ..., 3] == 255).all()
    assert (both[1, ..., 3] == 60).all()
    assert make_frames([VIEW], [plain], divisor).pixels.shape[-1] == 3


def test_smaller_photographs_are_padded():
    """Padding is not valid; intrinsics scale with the divisor."""
    large, small = photo_of(PIXELS), photo_of(PIXELS[:20, :30])
    frames = make_frames([VIEW] * 2, [large, small])
    np.testing.assert_array_equal(frames.pixels[1, :20, :30], small.pixels)
    assert frames.valid[0].all()
    assert frames.valid[1].sum() == 20 * 30
    assert frames.size.tolist() == [[32, 24], [30, 20]]
    half = make_frames([VIEW] * 2, [large, small], 2)
    assert half.pixels.shape == (2, 12, 16, 3)
    assert half.valid[1].sum() == 10 * 15
    np.testing.assert_allclose(half.camera.K[1], np.diag([0.5, 0.5, 1]) @ small.K)
    assert make_frames([VIEW] * 2, [large, large]).valid is None


@pytest.mark.parametrize("batch", [1, 3])
def test_each_view_once_per_epoch(batch):
    order = np.concatenate([views_of_step(5, step, batch, 4) for step in range(8)])
    epochs = order[: len(order) // 4 * 4].reshape(-1, 4)
    assert (np.sort(epochs, axis=1) == np.arange(4)).all()
    assert len({tuple(e) for e in epochs.tolist()}) > 1
