"""Datasets from arrays: what `fit` receives, and rejected arrays."""

import numpy as np
import pytest
from captures import dataset_of_views, rejects

import gsjax
from gsjax.data.arrays import make_dataset
from gsjax.train.health import check_photos

MADE = dataset_of_views(3, points=20)
RNG = np.random.default_rng(0)
IMAGES = RNG.integers(0, 256, (3, 24, 32, 3)).astype(np.uint8)


def singles(**more):
    size = {"width": 32, "height": 24} | more
    return [gsjax.make_camera(viewmat=v.viewmat, K=v.K, **size) for v in MADE.views]


def cameras(**more):
    return gsjax.stack_cameras(singles(**more))


@pytest.mark.parametrize("images", [IMAGES, list(IMAGES), IMAGES / 255])
@pytest.mark.parametrize("given", [cameras, singles])
def test_a_dataset_of_arrays(images, given):
    dataset, photos = make_dataset(images, given(), MADE.points, MADE.colors)
    np.testing.assert_array_equal(dataset.points, MADE.points)
    np.testing.assert_array_equal(dataset.colors, MADE.colors)
    for view, wanted, photo, image in zip(dataset.views, MADE.views, photos, IMAGES):
        np.testing.assert_allclose(view.viewmat, wanted.viewmat, atol=1e-6)
        np.testing.assert_allclose(view.K, wanted.K, rtol=1e-6)
        np.testing.assert_array_equal(photo.K, view.K)
        np.testing.assert_array_equal(photo.pixels, image)
        assert photo.alpha is None
        assert photo.valid is None
    check_photos(dataset, photos)  # as `fit` does


def test_names_sort_views_and_photos_and_alpha_and_masks_are_kept():
    rgba = np.concatenate([IMAGES, IMAGES[..., :1]], -1)
    valid = IMAGES[..., 1] > 99
    names = ["c", "a", "b"]
    dataset, photos = make_dataset(rgba, singles(), names=names, valid=valid)
    assert [view.name for view in dataset.views] == ["a", "b", "c"]
    assert dataset.points.shape == (0, 3)
    for photo, index in zip(photos, (1, 2, 0)):
        np.testing.assert_array_equal(photo.pixels, IMAGES[index])
        np.testing.assert_array_equal(photo.alpha, IMAGES[index, ..., 0])
        np.testing.assert_array_equal(photo.valid, valid[index])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"images": IMAGES[:2]}, "cameras: expected 2, one per image, got 3"),
        ({"images": IMAGES[:, :20]}, r"expected shape \[24, 32, 3 or 4\] .* got \(20"),
        ({"images": IMAGES[..., :2]}, r"got \(24, 32, 2\)"),
        ({"images": IMAGES.astype(int)}, "expected uint8 or floats .* got int64"),
        ({"images": IMAGES * 1.0}, r".*floats in \[0, 1\], got 0 to 255"),
        ({"images": IMAGES * np.nan}, r".*floats in \[0, 1\], got nan"),
        ({"cameras": [3, 4, 5]}, r"cameras\[0\]: expected a single Camera, got 3"),
        ({"cameras": [cameras()] * 3}, "expected a single Camera, got Camera.*batch"),
        ({"cameras": cameras(lens="orthographic")}, "one of .*, got orthographic"),
        ({"points": MADE.points[:, :2]}, r"points: .* of shape \(20, 2\)"),
        ({"points": [["a", "b", "c"]]}, "points: expected numbers"),
        ({"points": MADE.points, "colors": MADE.colors[:9]}, r"colors: .*\(9, 3\)"),
        ({"names": ["a", "b"]}, "names: expected 3, one per image, got 2"),
        ({"names": ["a", "b", "a"]}, "'a' is listed more than once"),
        ({"valid": IMAGES}, "valid of the photo: expected bool"),
    ],
)
def test_bad_arrays(change, expected):
    given = {"images": IMAGES, "cameras": cameras(), **change}
    rejects(expected, make_dataset, **given)
