"""Plots and contact sheets hold their data, and any values give a picture."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import frustum_points, gaussians_at

import gsjax
from gsjax.plots.contact_sheets import (
    SheetRow,
    comparison,
    depth_colors,
    display_pixels,
)
from gsjax.plots.figures import (
    Series,
    curves,
    curves_figure,
    histograms,
    histograms_figure,
)
from gsjax.runs import history

WIDTH, HEIGHT = 100, 48
MAGENTA = (255, 0, 255)


def scene(scales=0.1, opacities=0.5, count=64):
    points = frustum_points(np.random.default_rng(0), count)
    return gaussians_at(points, scales, opacities, degree=0)


def test_importing_gsjax_does_not_load_matplotlib():
    """Matplotlib takes long to import, so it is imported inside functions."""
    files = Path(gsjax.__file__).parent.rglob("*.py")
    eager = re.compile(r"^(import|from) (matplotlib|pylab)", re.MULTILINE)
    assert not [path for path in files if eager.search(path.read_text())]


def test_series_and_marks_reach_the_figure():
    x = np.arange(100.0)
    y = np.where((x > 40) & (x < 60), np.nan, 3 * x)
    lines = [Series("up", x, y), Series("inf", x, np.full(100, np.inf), faint=True)]
    (axes,) = curves_figure(lines, marks={"half the size": 7, "full size": 50}).axes
    up, infinite, first, second = axes.lines
    np.testing.assert_array_equal(up.get_xydata(), np.stack([x, y], 1))
    assert not np.isfinite(infinite.get_ydata()).any()
    assert [line.get_xdata()[0] for line in (first, second)] == [7, 50]


@pytest.mark.parametrize(
    "series",
    [
        [],
        [Series("none", [], [])],
        [Series("nan", [0, 1], [np.nan, np.inf])],
        [Series("one $point_$ 日", [5], [7])],
        [Series("flat", [0, 1, 2], [0, 0, 0])],
        [Series("huge", [0, 1e9], [-1e30, 1e30]), Series("tiny", [3, 3], [1e-30, 0])],
        [Series(f"line {i}", range(9), np.arange(9) * i) for i in range(12)],
    ],
    ids=lambda series: series[0].label if series else "empty",
)
def test_any_series_give_a_picture(series):
    plot = curves(series, title="title ×", size=(301, 203))
    assert plot.shape == (203, 301, 3)
    assert plot.dtype == np.uint8
    assert (plot < 128).any()


@pytest.mark.parametrize("divisors", [[4, 4, 2, 1, 1], [1, 1], [None, None]])
def test_the_curves_of_a_run_are_a_png(divisors, tmp_path):
    records = [
        {"step": i + 1, "psnr": 20.0, "gaussians": 1000 + i, "divisor": divisor}
        for i, divisor in enumerate(divisors)
    ]
    history.plot_curves(tmp_path / "a.png", records, 2)
    assert cv2.imread(str(tmp_path / "a.png")).shape == (420, 720, 3)


def test_histograms_count_the_values():
    axes = histograms_figure(scene((0.02, 0.1, 0.5), 0.9), title="a").axes
    for each, values in zip(axes, [[0.9], [0.02, 0.1, 0.5], [25.0]]):
        for patch, value in zip(each.patches, values, strict=True):
            counts, edges, _ = patch.get_data()
            (index,) = np.flatnonzero(counts)
            assert counts[index] == 64
            assert edges[index] <= value * 1.0001
            assert value <= edges[index + 1] * 1.0001


@pytest.mark.parametrize(("count", "hidden"), [(4000, 4), (300, 1)])
def test_outliers_do_not_set_the_axes_and_are_counted(count, hidden):
    """One value in a thousand at either end is left out, and the label says so."""
    scales = np.full((count, 3), 0.02)
    scales[:2, 0], scales[2, 0] = 1e-9, 1e7
    broken = scene(scales, count=count)
    logs = broken.params.log_scales.at[-1, 0].set(np.nan)
    broken = broken.replace(params=broken.params.replace(log_scales=logs))
    axes = histograms_figure(broken).axes[1]
    low, high = axes.get_xlim()
    assert (low <= 1e-9 and high >= 1e7) == (count < 1000)
    assert low < 0.02 < high
    assert f"({hidden} not shown)" in axes.get_xlabel()


def test_any_scene_gives_histograms():
    good = scene()
    logs = good.params.log_scales.at[:9].set(np.nan).at[10:13].set(1e30)
    logits = good.params.logit_opacities.at[3].set(np.inf).at[4].set(np.nan)
    broken = good.params.replace(log_scales=logs, logit_opacities=logits)
    empty = good.replace(active=np.zeros(64, bool))
    for each in (good.replace(params=broken), empty):
        plot = histograms(each, title="ü")
        assert plot.shape == (900, 720, 3)
        assert plot.dtype == np.uint8


# Contact sheets.


def row(width=WIDTH, height=HEIGHT, **changes):
    truth = np.random.default_rng(0).integers(40, 200, (height, width, 3), np.uint8)
    y, x = np.mgrid[:height, :width]
    depth = np.where(x > 8, 1.0 + y / height, 0)
    return SheetRow("a.png", truth, truth / 255 + 0.05, depth)._replace(**changes)


def cells(one):
    """Return the pictures of a sheet of one row, without margins and captions."""
    parts = np.split(comparison([one], width=WIDTH), 4, axis=1)
    return [part[3 : 3 + HEIGHT, 3 : 3 + WIDTH].astype(int) for part in parts]


def test_cells_are_the_pictures():
    """Pixels that are not finite are magenta, or without depth."""
    one = row()
    truth, render, error, depth = whole = cells(one)
    np.testing.assert_array_equal(truth, one.truth)
    np.testing.assert_allclose(render, 255 * one.render, atol=0.51)
    np.testing.assert_allclose(error, 4 * 0.05 * 255, atol=1)
    np.testing.assert_array_equal(depth, depth_colors(one.depth)[0])
    assert (depth[:, :9] == depth[0, 0]).all(), "no depth"
    near, far = depth[1, 20], depth[-2, 20]
    assert near[0] > near[2] + 60, "red"
    assert far[2] > far[0], "blue"
    one.render[5, 10], one.render[20, 30, 1], one.depth[3, 40] = np.nan, np.inf, np.nan
    for cell, good in zip(cells(one)[1:3], whole[1:3]):
        good[[5, 20], [10, 30]] = MAGENTA
        np.testing.assert_array_equal(cell, good)
    np.testing.assert_array_equal(cells(one)[3][3, 40], depth[0, 0])


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
    # Between limits, a depth has one colour whatever else the image shows.
    flat, *_ = depth_colors(np.full((1, 2), 2.5), (2, 4))
    mixed, *limits = depth_colors(np.array([[2.5, 3.9]]), (2, 4))
    assert limits == [2, 4]
    assert (mixed == flat).all(-1).tolist() == [[True, False]]


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
