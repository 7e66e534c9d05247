"""Histograms: ink where the values are, for any scene; and `gsjax info --plot`."""

import cv2
import numpy as np
import pytest
from conftest import frustum_points, gaussians_at

import gsjax
from gsjax import cli
from gsjax.histograms import histograms

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
    assert cli.main(["info", str(ply), "--plot", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    assert cv2.imread(str(out)).shape == (900, 720, 3)
    assert cli.main(["info", str(ply), "--plot", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    assert cli.main(["info", str(ply), "--plot", "a.jpg"]) == 2
