"""Sheets and curves: sizes, what the cells hold, and values that are not finite."""

import re
from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest

import gsjax
from gsjax.plots import contact_sheets
from gsjax.plots.contact_sheets import (
    MAGNIFIED,
    SheetRow,
    comparison,
    depth_colors,
    text_width,
    wrapped,
)
from gsjax.plots.curves import Mark, Series, curves, curves_png
from gsjax.runs import history

WIDTH = 64


def row(width=WIDTH, height=48, depth=True, name="a.png", **changes):
    rng = np.random.default_rng(0)
    truth = rng.integers(40, 200, (height, width, 3), np.uint8)
    render = np.clip(truth / 255 + 0.05, 0, 1)
    y, x = np.mgrid[:height, :width]
    fields = {
        "name": name,
        "truth": truth,
        "render": render,
        "depth": np.where(x > 8, 1.0 + y / height, 0) if depth else None,
    }
    return SheetRow(**{**fields, **changes})


def cells(sheet, count):
    """The pictures of a sheet of one row, without margin and caption."""
    each = np.split(sheet, count, axis=1)
    return [cell[3:51, 3 : 3 + WIDTH].astype(int) for cell in each]


def test_the_cells_are_the_pictures():
    one = row()
    sheet = comparison([one], width=WIDTH)
    assert sheet.dtype == np.uint8
    truth, render, error, depth = cells(sheet, 4)
    np.testing.assert_array_equal(truth, one.truth)
    np.testing.assert_allclose(render, 255 * one.render, atol=0.51)
    np.testing.assert_allclose(error, MAGNIFIED * 0.05 * 255, atol=1)
    assert (depth[:, :9] == depth[0, 0]).all()  # nothing there
    near, far = depth[1, 20], depth[-2, 20]
    assert near[0] > near[2] + 60  # red
    assert far[2] > far[0]  # blue
    assert sheet[52:66].max() > 120  # captions


def test_the_caption_says_which_depths_are_coloured(monkeypatch):
    """Not the least and the greatest, which a depth picture has."""
    said = []
    monkeypatch.setattr(
        "gsjax.plots.contact_sheets.put_text", lambda _, text, *__: said.append(text)
    )
    comparison([row()], width=300)
    (told,) = [text for text in said if text.startswith("depth")]
    assert told.startswith("depth, 2 to 98 %: ")


@pytest.mark.parametrize("width", [64, 96, 120, 128, 155, 320])
def test_no_caption_is_cut(width, monkeypatch):
    """All of it is written, in lines that neither leave their cell nor its bar."""
    written = []

    def put_text(cell, text, place, *_):
        written.append(text)
        assert place[0] + text_width(text) <= cell.shape[1]
        assert place[1] + 5 < cell.shape[0], "what hangs below a line"

    monkeypatch.setattr("gsjax.plots.contact_sheets.put_text", put_text)
    name = "a long name/" + 40 * "x" + "Ü.png"
    comparison([row(name=name, rendered="step 12345,")], width=width)
    told = "".join(written).replace(" ", "")
    assert told.startswith(name.replace(" ", "") + "step12345,26.")
    assert re.search(r"dBerrorx4depth,2to98%:[\d.]+to[\d.]+$", told)


@pytest.mark.parametrize("width", [1, 30, 90, 500])
def test_wrapped_lines_are_words_that_fit(width):
    text = "depth, 2 to 98 %: 3.42 to 5.99 of " + 30 * "W"
    lines = wrapped(text, width)
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")
    assert all(text_width(line) <= width or len(line) == 1 for line in lines)
    for first, second in pairwise(lines):  # none is broken that has room
        assert text_width(f"{first} {second.split()[0]}") > width
    assert wrapped("", width) == [""]


def test_rows_of_several_sizes_and_without_depth():
    rows = [row(), row(128, 40), row(33, 70, depth=False, name="Ünï" + 90 * "x")]
    sheet = comparison(rows, width=100)
    heights = [round(100 * h / w) for w, h in ((64, 48), (128, 40), (33, 70))]
    assert sheet.shape[1:] == (4 * 106, 3)
    assert sheet.shape[0] >= sum(heights) + 3 * 26
    wide = comparison([row(depth=False)], width=200)
    assert wide.shape == (176, 3 * 206, 3), "captions of one line"
    assert comparison([row(1, 1)], width=1).shape[1] == 28


def test_what_is_not_finite_is_magenta():
    one = row()
    one.render[5:9, 10:20] = np.nan
    one.render[20, 30, 1] = np.inf
    one.depth[3, 40] = np.nan
    _, render, error, depth = cells(comparison([one], width=WIDTH), 4)
    for cell in (render, error):
        found = (cell == (255, 0, 255)).all(axis=-1)
        assert found[5:9, 10:20].all()
        assert found[20, 30]
        assert found.sum() == 41
    np.testing.assert_array_equal(depth[3, 40], depth[0, 0])
    everything = row(render=np.full((48, 64, 3), np.nan))
    assert comparison([everything], width=WIDTH).shape[1] == 4 * 70


def test_equal_pictures_and_empty_depth():
    one = row(depth=False)
    same = one._replace(render=one.truth, depth=np.zeros((48, 64)))
    _, _, error, depth = cells(comparison([same], width=WIDTH), 4)
    assert not error.any()
    assert (depth == depth[0, 0]).all()
    flat, near, far = depth_colors(np.full((4, 5), 2.0))
    assert (flat == flat[0, 0]).all()
    assert near == far == 2


def test_sheets_that_are_refused():
    with pytest.raises(gsjax.InputError, match="at least one row"):
        comparison([])
    with pytest.raises(gsjax.InputError, match=r"a.png: .* the render \(9, 9, 3\)"):
        comparison([row(render=np.zeros((9, 9, 3)))])
    with pytest.raises(gsjax.InputError, match="the depth is"):
        comparison([row()._replace(depth=np.zeros((9, 9)))])
    with pytest.raises(gsjax.InputError, match=r"\[H, W, 3\] is wanted"):
        comparison([row(truth=np.zeros((48, 64)))])


def inked(plot):
    """Where the frame of a plot has a colour, not grey."""
    inside = plot[40:-46, 66:-20].astype(int)
    return np.ptp(inside, axis=-1) > 60


def test_a_curve_goes_where_its_values_are():
    x = np.arange(100)
    ink = inked(curves([Series("up", x, 3.0 * x)], size=(400, 300)))
    rows, columns = np.nonzero(ink)
    assert ink.sum() > 300
    assert np.corrcoef(rows, columns)[0, 1] < -0.999  # rows run downward
    holed = 3.0 * x
    holed[40:60] = np.nan
    gap = inked(curves([Series("up", x, holed)], size=(400, 300)))
    middle = gap.shape[1] // 2
    assert not gap[:, middle - 20 : middle + 20].any()
    assert gap.sum() > 0.6 * ink.sum()


def test_a_logarithmic_axis_takes_powers_for_steps():
    """10^x over such an axis is x over a plain one; what is not above 0 is left out."""
    x = np.arange(1, 50)
    y = np.sqrt(x)
    plain = inked(curves([Series("up", x, y)], size=(400, 300)))
    powers = Series("up", [-1.0, 0.0, *10.0**x], [0.0, 9.0, *y])
    found = inked(curves([powers], size=(400, 300), log_x=True))
    # But for pixels where one has a line of the grid, and the other none.
    assert (found != plain).sum() < 0.02 * plain.sum()


@pytest.mark.parametrize(
    "series",
    [
        [],
        [Series("none", [], [])],
        [Series("nan", [0, 1], [np.nan, np.inf])],
        [Series("one", [5], [7])],
        [Series("flat", [0, 1, 2], [0, 0, 0])],
        [Series("huge", [0, 1e9], [-1e30, 1e30]), Series("tiny", [3, 3], [1e-30, 0])],
        [Series(f"line {i}", range(9), np.arange(9) * i) for i in range(12)],
    ],
)
def test_curves_of_anything_are_a_picture(series):
    plot = curves(series, title="title ×", size=(300, 200))
    assert plot.shape == (200, 300, 3)
    assert (plot < 128).any()


def test_marks_stand_where_they_say_and_their_names_apart(monkeypatch):
    """Each name within the frame and none over another, however close the marks."""
    boxes = []

    def put_text(plot, text, place, color, size=0.42):
        if text.startswith("1/"):
            boxes.append((place, text_width(text, size)))
        contact_sheets.put_text(plot, text, place, color, size)

    monkeypatch.setattr("gsjax.plots.curves.put_text", put_text)
    x = np.arange(101)
    line = Series("flat", x, np.full(101, 3.0))
    marks = [Mark(f"1/{i} of the size", at) for i, at in enumerate((0, 4, 60, 98))]
    bare = curves([line], size=(400, 300))
    plot = curves([line], size=(400, 300), marks=[*marks, Mark("1/9", 500)])
    changed = (plot != bare).any(axis=-1)
    full = np.flatnonzero(changed[40:200].mean(axis=0) > 0.9)  # the line lies over them
    frame = np.asarray([62, 400 - 18])
    wanted = [round(frame[0] + np.ptp(frame) * at / 100) for at in (0, 4, 60, 98)]
    assert full.tolist() == wanted
    assert len(boxes) == 4, "none beyond the frame"
    for (a, wide), (b, _) in combinations(sorted(boxes), 2):
        assert abs(a[1] - b[1]) >= 12 or b[0] > a[0] + wide
    assert all(frame[0] < u and u + wide <= frame[1] for (u, _), wide in boxes)


@pytest.mark.parametrize(
    ("low", "high"), [(24.3582, 24.3684), (1e6, 1.0001e6), (-0.001, 0.002), (3, 5e4)]
)
def test_no_two_ticks_say_the_same(low, high, monkeypatch):
    said = []
    monkeypatch.setattr(
        "gsjax.plots.curves.put_text", lambda _, text, *__: said.append(text)
    )
    curves([Series("", [777, 778], [low, high])], size=(400, 600))
    upright = said[: said.index("777")]  # those along x begin there
    assert len(upright) >= 5
    assert len(set(upright)) == len(upright)


@pytest.mark.parametrize(("y", "wanted"), [((3, 3.01), (0.2, 0.4)), ((3, 5), (0.8, 1))])
def test_noise_is_not_drawn_as_a_rise(y, wanted):
    """Two ends nearer to one another than is shown at least are drawn near, too."""
    plain, shown = (
        inked(curves([Series("a", [0, 1], y)], size=(400, 300), least=least))
        for least in (0, 0.04)
    )
    assert 0.8 < np.ptp(np.nonzero(plain)[0]) / 226 < 1
    assert wanted[0] < np.ptp(np.nonzero(shown)[0]) / 226 < wanted[1]


def test_the_curves_of_a_run_mark_the_size_of_its_images(tmp_path, monkeypatch):
    """And say of which moment the count is."""
    told = {}
    monkeypatch.setattr(history, "curves_png", lambda *_, **more: told.update(more))

    def records(divisors):
        return [
            {"step": i + 1, "psnr": 20.0, "gaussians": 1000 + i, "divisor": divisor}
            for i, divisor in enumerate(divisors)
        ]

    history.write_curves(tmp_path / "a.png", records([4, 4, 2, 1, 1]), 2)
    marks = [("1/4 of the size", 1), ("1/2 of the size", 3), ("full size", 4)]
    assert told["marks"] == marks
    assert told["x_label"] == "step (1,004 Gaussians after the last)"
    for same in ([1, 1], [None, None]):
        history.write_curves(tmp_path / "a.png", records(same), 2)
        assert told["marks"] == []


def test_curves_file_and_refusals(tmp_path):
    curves_png(tmp_path / "a.png", [Series("a", [0, 1], [1, 2])], title="a")
    assert cv2.imread(str(tmp_path / "a.png")).shape == (420, 720, 3)
    with pytest.raises(gsjax.InputError, match=r"a: x is \(1,\), y is \(2,\)"):
        curves([Series("a", [0], [1, 2])])
    with pytest.raises(gsjax.InputError, match="at least 200"):
        curves([], size=(100, 100))
