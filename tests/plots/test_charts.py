"""Charts: data reach the figure, and any values give a picture of the right size."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import frustum_points, gaussians_at

import gsjax
from gsjax.cli.main import main
from gsjax.plots.figures import (
    Series,
    curves,
    curves_figure,
    histograms,
    histograms_figure,
)
from gsjax.runs import history


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
    assert [text.get_text() for text in axes.texts] == ["half the size", "full size"]


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
    assert [each.get_xscale() for each in axes] == ["linear", "log", "log"]


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
    assert axes.get_xlabel() == f"scale, world units ({hidden} not shown)"


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


def test_info_writes_histograms(tmp_path, capsys):
    ply, out = tmp_path / "a.ply", tmp_path / "new" / "a.png"
    gsjax.save(ply, scene())
    assert main(["info", str(ply), "--plot", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    assert cv2.imread(str(out)).shape == (900, 720, 3)
    assert main(["info", str(ply), "--plot", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    assert main(["info", str(ply), "--plot", "a.jpg"]) == 2
