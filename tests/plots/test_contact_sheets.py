"""Contact sheets hold their pictures pixel by pixel; other values do not break them."""

import numpy as np
import pytest

import gsjax
from gsjax.plots.contact_sheets import (
    Cell,
    SheetRow,
    cell_grid,
    comparison,
    depth_colors,
    display_pixels,
)

WIDTH, HEIGHT = 100, 48
MAGENTA = (255, 0, 255)


def row(width=WIDTH, height=HEIGHT, **changes):
    truth = np.random.default_rng(0).integers(40, 200, (height, width, 3), np.uint8)
    y, x = np.mgrid[:height, :width]
    depth = np.where(x > 8, 1.0 + y / height, 0)
    return SheetRow("a.png", truth, truth / 255 + 0.05, depth)._replace(**changes)


def cells(one):
    """The pictures of a sheet of one row, without margins and captions."""
    parts = np.split(comparison([one], width=WIDTH), 4, axis=1)
    return [part[3 : 3 + HEIGHT, 3 : 3 + WIDTH].astype(int) for part in parts]


def test_cells_are_the_pictures():
    one = row()
    truth, render, error, depth = cells(one)
    np.testing.assert_array_equal(truth, one.truth)
    np.testing.assert_allclose(render, 255 * one.render, atol=0.51)
    np.testing.assert_allclose(error, 4 * 0.05 * 255, atol=1)
    np.testing.assert_array_equal(depth, depth_colors(one.depth)[0])
    assert (depth[:, :9] == depth[0, 0]).all(), "no depth"
    near, far = depth[1, 20], depth[-2, 20]
    assert near[0] > near[2] + 60, "red"
    assert far[2] > far[0], "blue"


def test_pixels_that_are_not_finite_are_magenta():
    one = row()
    one.render[5:9, 10:20] = np.nan
    one.render[20, 30, 1] = np.inf
    one.depth[3, 40] = np.nan
    _, render, error, depth = cells(one)
    for cell in (render, error):
        found = (cell == MAGENTA).all(axis=-1)
        assert found[5:9, 10:20].all()
        assert found[20, 30]
        assert found.sum() == 41
    np.testing.assert_array_equal(depth[3, 40], depth[0, 0])


def test_rows_of_several_sizes():
    rows = [row(), row(128, 40), row(33, 70, name="Ünï $ 日 \x07\n" + 90 * "x")]
    sheet = comparison(rows, width=100)
    assert sheet.shape[1:] == (4 * 106, 3)
    assert sheet.shape[0] > 48 + 31 + 212
    assert comparison([row(1, 1)], width=1).shape[0] > 1


def test_equal_pictures_and_empty_depth():
    one = row(depth=np.zeros((HEIGHT, WIDTH)))
    _, _, error, depth = cells(one._replace(render=one.truth))
    assert not error.any()
    assert (depth == depth[0, 0]).all()
    flat, near, far = depth_colors(np.full((4, 5), 2.0))
    assert (flat == flat[0, 0]).all()
    assert near == far == 2


@pytest.mark.parametrize("caption", ["", "a caption"])
def test_a_grid_keeps_every_pixel(caption):
    pictures = np.random.default_rng(1).integers(0, 256, (3, 12, 16, 3), np.uint8)
    grid = cell_grid([Cell(picture, caption) for picture in pictures], columns=2)
    windows = np.lib.stride_tricks.sliding_window_view(grid, (12, 16, 3))[:, :, 0]
    for picture in pictures:
        assert (windows == picture).all(axis=(2, 3, 4)).sum() == 1
    assert (grid.shape[0] > 40) == bool(caption)


@pytest.mark.parametrize(
    ("call", "argument", "message"),
    [
        (comparison, [], "at least one picture"),
        (comparison, [row(render=np.zeros((9, 9, 3)))], r"a.png: .* \(9, 9, 3\)"),
        (comparison, [row(depth=np.zeros((9, 9)))], r"a.png: .* depth \[H, W\]"),
        (comparison, [row(truth=np.zeros((48, 64)))], r"a.png: .* \[H, W, 3\]"),
        (display_pixels, np.zeros((3, 4, 2)), r"got \(3, 4, 2\)"),
        (display_pixels, np.zeros((0, 4, 3)), r"got \(0, 4, 3\)"),
    ],
)
def test_errors(call, argument, message):
    with pytest.raises(gsjax.InputError, match=message):
        call(argument)
