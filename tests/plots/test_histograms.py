"""Histograms: ink where the values are, for any scene; and `gsjax info --plot`."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from conftest import frustum_points, gaussians_at

import gsjax
from gsjax.cli.main import main
from gsjax.plots import curves
from gsjax.plots.contact_sheets import text_width
from gsjax.plots.histograms import histograms

BLUE = np.array((38, 98, 186))


def scene(scales, opacities=0.5, count=64):
    return gaussians_at(
        frustum_points(np.random.default_rng(0), count), scales, opacities
    )


def columns(plot, panel):
    """Share of the frame's width at which the first line of a panel leaves zero."""
    part = plot[300 * panel : 300 * (panel + 1)].astype(int)
    frame = part[40:250, 62:-18]
    return np.nonzero((np.abs(frame - BLUE).sum(-1) < 60).any(0))[0] / frame.shape[1]


@pytest.mark.parametrize("opacity", [0.2, 0.5, 0.9])
def test_opacity_is_where_it_is(opacity):
    where = columns(histograms(scene(0.1, opacity)), 0)
    assert len(where)
    assert abs(where.mean() - opacity) < 0.02


def test_scales_and_their_ratio_are_on_logarithmic_axes():
    # The axis of the scales runs from 0.01 to 1, that of their ratio from 10 to 100.
    plot = histograms(scene((0.02, 0.1, 0.5)))
    assert abs(columns(plot, 1).mean() - np.log10(2) / 2) < 0.03  # of the shortest
    assert abs(columns(plot, 2).mean() - np.log10(2.5)) < 0.03


@pytest.mark.parametrize("decades", [1, 2, 3, 4, 4.5, 7, 8, 12, 20, 40])
def test_ticks_of_decades_leave_room_for_one_another(decades):
    low, room = -4.5, 720 - curves.LEFT - curves.RIGHT
    ticks = curves._ticks(low, low + decades, room // 90, True)
    assert len(ticks) >= 2
    spans = [
        (room * (place - low) / decades, text_width(text) / 2) for place, text in ticks
    ]
    for (a, half_a), (b, half_b) in pairwise(spans):
        assert b - a >= half_a + half_b + 6, [text for _, text in ticks]
    assert not any(text.endswith("M") for _, text in ticks), "1e9, not 1000M"
    for place, text in ticks:
        value = float(text.replace("k", "e3"))
        assert ("e" in text) == ("e" in ticks[0][1]), "one notation"
        assert abs(np.log10(value) - place) < 1e-6


def test_what_is_counted_is_said(monkeypatch):
    said = []

    def axes(*args, title="", y_label="", **more):
        said.append((title, y_label))
        return curves.axes(*args, title=title, y_label=y_label, **more)

    monkeypatch.setattr("gsjax.plots.histograms.axes", axes)
    histograms(scene(0.1), title="a")
    # A legend stands where the second would have the label.
    assert said == [("a: 64 Gaussians", "count"), ("count by axis", ""), ("", "count")]


def test_outliers_do_not_own_the_axes(monkeypatch):
    """One value in a thousand at either end; and none is left out in silence."""
    said = []

    def axes(x, *args, x_label="", **more):
        said.append((x, x_label))
        return curves.axes(x, *args, x_label=x_label, **more)

    monkeypatch.setattr("gsjax.plots.histograms.axes", axes)
    for count, low, high in ((4000, 2, 1), (4000, 0, 0), (300, 1, 1)):
        scales = np.full((count, 3), 0.02)
        scales[:low, 0], scales[low : low + high, 0] = 1e-9, 1e7
        broken = scene(scales, count=count)
        logs = broken.params.log_scales.at[-1, 0].set(np.nan)
        said.clear()
        histograms(broken.replace(params=broken.params.replace(log_scales=logs)))
        (_, opacity), (x, told), (ratio, _) = said
        assert opacity == "opacity"
        if count < 1000:  # too few for quantiles of a thousandth
            assert x[0] <= -9
            assert x[1] >= 7
            assert told == "scale, world units (1 not finite)"
            continue
        assert x == (-2.0, -1.0)
        assert 0 <= ratio[0] < ratio[1] <= 1
        outside = f"{low} below, {high} above, " if low else ""
        assert told == f"scale, world units ({outside}1 not finite)"


def test_any_scene_is_a_picture():
    good = scene(0.1)
    broken = good.params.replace(
        log_scales=good.params.log_scales.at[:9].set(np.nan),
        logit_opacities=good.params.logit_opacities.at[3].set(np.inf),
    )
    empty = good.replace(active=np.zeros(64, bool))
    for each in (good, good.replace(params=broken), empty):
        plot = histograms(each, title="ü")
        assert plot.shape == (900, 720, 3)
        assert plot.dtype == np.uint8
        assert (plot < 128).any()


def test_info_draws_it(tmp_path, capsys):
    ply, out = tmp_path / "a.ply", tmp_path / "new" / "a.png"
    gsjax.save(ply, scene(0.1))
    assert main.main(["info", str(ply), "--plot", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    assert cv2.imread(str(out)).shape == (900, 720, 3)
    assert main.main(["info", str(ply), "--plot", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    assert main.main(["info", str(ply), "--plot", "a.jpg"]) == 2
