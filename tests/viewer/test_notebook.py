"""What a notebook shows: the pixels themselves, every one of a batch, no tracers."""

import base64
import json
import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import WIDTH, camera_of, scene_of

import gsjax
from gsjax.io.images import to_8_bit
from gsjax.plots import contact_sheets, previews
from gsjax.plots.contact_sheets import text_width
from gsjax.raster.types import Demand, Render
from gsjax.viewer import notebook
from gsjax.viewer.notebook import Picture, live, movie, picture, show

MAGENTA = (255, 0, 255)
NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))


def random_picture(height=12, width=16, seed=0):
    return np.random.default_rng(seed).uniform(size=(height, width, 3))


def pixels_of(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def shown(value) -> np.ndarray:
    png, _ = value._repr_png_()
    return pixels_of(png)


def render_of(batch=(), overflowed=False, **images) -> Render:
    """What a render might return, without rendering."""
    images = {"rgb": None, "alpha": None, "depth": None, "median_depth": None, **images}
    demand = Demand(*(jnp.int32(1),) * 3)
    radii = jnp.zeros((*batch, 3))
    return Render(**images, radii=radii, demand=demand, overflowed=jnp.bool(overflowed))


# --- pictures ---


def test_one_picture_is_that_picture():
    image = random_picture()
    np.testing.assert_array_equal(shown(picture(image)), to_8_bit(image))
    eight = to_8_bit(image)
    np.testing.assert_array_equal(shown(picture(eight)), eight)
    grey = shown(picture(image[..., 0]))
    np.testing.assert_array_equal(grey, np.repeat(eight[..., :1], 3, axis=2))
    np.testing.assert_array_equal(shown(picture(picture(image))), eight)


def test_a_small_one_is_shown_enlarged_and_stored_as_it_is():
    png, size = picture(random_picture(12, 16))._repr_png_()
    assert size == {"width": 240, "height": 180}
    assert pixels_of(png).shape == (12, 16, 3)


def test_zoom_repeats_pixels():
    image = to_8_bit(random_picture())
    found = shown(picture(image, zoom=3))
    for y, x in np.ndindex(3, 3):
        np.testing.assert_array_equal(found[y::3, x::3], image)


def test_what_is_not_finite_is_magenta():
    image = random_picture()
    image[3, 4, 1] = np.nan
    found = shown(picture(image))
    assert tuple(found[3, 4]) == MAGENTA
    assert (found != MAGENTA).any(axis=-1).sum() == 12 * 16 - 1


@pytest.mark.parametrize("columns", [1, 2, 3, None])
def test_a_batch_is_a_sheet_that_holds_every_picture(columns):
    batch = np.stack([random_picture(seed=seed) for seed in range(3)])
    for found in (
        picture(batch, columns=columns).pixels,
        picture(*batch, captions=["a", "b", "c"], columns=columns).pixels,
    ):
        for image in to_8_bit(batch):
            windows = np.lib.stride_tricks.sliding_window_view(found, (12, 16, 3))
            assert (windows[:, :, 0] == image).all(axis=(2, 3, 4)).sum() == 1


def test_a_sheet_is_small():
    sheet = picture(np.zeros((30, 40, 500, 3)), columns=30).pixels
    assert sheet.shape[1] == 1200


@pytest.mark.parametrize("width", [4, 60, 96, 150, 400])
def test_no_caption_of_a_sheet_is_cut(width, monkeypatch):
    """All of it is written, in lines that leave neither their cell nor the sheet."""
    captions = ["rgb", "median depth 3.42 to 5.99", "depth 1 to 2"]
    written = []

    def put_text(row, text, place, _, size):
        written.append(text)
        assert place[0] + text_width(text, size) <= row.shape[1]
        assert place[1] + 4 < row.shape[0], "what hangs below a line"

    monkeypatch.setattr(previews, "put_text", put_text)
    picture(*[np.zeros((9, width))] * 3, captions=captions, columns=1)
    assert " ".join(written) == " ".join(captions)


def test_wrong_pictures():
    with pytest.raises(gsjax.InputError, match=r"a picture is \(1, 2, 3, 4, 5\)"):
        picture(np.zeros((1, 2, 3, 4, 5)))
    with pytest.raises(gsjax.InputError, match="2 captions for 1 pictures"):
        picture(random_picture(), captions=["a", "b"])
    with pytest.raises(gsjax.InputError, match="zoom is 0"):
        picture(random_picture(), zoom=0)
    with pytest.raises(gsjax.InputError, match="no pictures"):
        picture()


# --- what displays itself ---


def test_a_render_shows_its_images():
    image = random_picture()
    alone = render_of(rgb=jnp.asarray(image))
    np.testing.assert_array_equal(shown(alone), to_8_bit(image))
    full = shown(render_of(rgb=image, alpha=image[..., 0], depth=1 + image[..., 0]))
    told = ["rgb", "alpha", "depth 1.00 to 1.00"]
    assert full.shape == shown(picture(*[image] * 3, captions=told)).shape
    incomplete = shown(render_of(rgb=image, overflowed=True))
    assert incomplete.shape != shown(alone).shape


def test_a_batch_of_renders_is_a_sheet():
    images = np.stack([random_picture(seed=seed) for seed in range(5)])
    found = shown(render_of((5,), rgb=images))
    told = [f"{index}: rgb" for index in range(5)]
    assert found.shape == shown(picture(images, captions=told)).shape
    many = np.zeros((1000, 8, 8, 3))
    cells = previews.of_render(render_of((1000,), rgb=many))
    assert len(cells) == 24


def test_features_show_as_colours():
    for channels in (1, 2, 5):
        features = np.full((6, 7, channels), 0.5)
        assert shown(render_of(rgb=features))[0, 0, 0] == 128


def test_gaussians_show_a_sketch_of_their_colours():
    scene, _ = scene_of("random")
    found = shown(scene)
    sketch = found[:240, :320].reshape(-1, 3).astype(int)
    assert len(np.unique(sketch, axis=0)) > 50
    assert len(scene._repr_png_()[0]) < 200_000
    empty = gsjax.select(scene, jnp.zeros(scene.capacity, bool))
    assert len(np.unique(shown(empty)[:240, :320].reshape(-1, 3), axis=0)) == 1


def test_gaussians_that_are_not_finite_do_not_stop_a_display():
    scene, _ = scene_of("random")
    leaves = jax.tree.map(lambda a: a.at[::3].set(jnp.nan), scene.params)
    assert shown(scene.replace(params=leaves)).shape == shown(scene).shape


def test_a_batch_of_gaussians_is_a_sheet():
    scene, _ = scene_of("random")
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), scene)
    assert [cell.caption for cell in previews.of_gaussians(batch)] == [
        "0: 192 Gaussians",
        "1: 192 Gaussians",
    ]
    first = shown(scene)[:240, :320]
    np.testing.assert_array_equal(shown(batch)[2:242, 2:322], first)


def test_a_camera_says_where_it_is():
    viewmat = gsjax.look_at((1.0, -5.0, 2.0), (1.0, 0.0, 2.0))
    text = camera_of(viewmat=viewmat)._repr_html_()
    assert "at (1, -5, 2)" in text
    assert "looking along (0.00, 1.00, 0.00)" in text
    assert f"{WIDTH} × " in text
    batch = gsjax.stack_cameras([camera_of(), camera_of(), camera_of()])
    assert "3 cameras" in batch._repr_html_()


def test_under_tracing_nothing_is_drawn():
    scene, camera = scene_of("random")
    seen = []

    @jax.jit
    def traced(scene, camera, image):
        view = render_of(rgb=image)
        seen.extend([scene._repr_png_(), camera._repr_html_(), view._repr_png_()])
        return image

    traced(scene, camera, random_picture())
    jax.vmap(lambda image: traced(scene, camera, image))(random_picture()[None])
    assert len(seen) >= 3
    assert not any(seen)


def test_of_what_holds_no_arrays_nothing_is_drawn():
    scene, camera = scene_of("random")
    shapes = jax.eval_shape(lambda s: s, scene)
    assert shapes._repr_png_() is None
    assert jax.tree.map(lambda _: None, scene)._repr_png_() is None
    assert jax.tree.map(lambda _: "x", camera)._repr_html_() is None
    given = jax.tree.map(jnp.copy, scene)
    jax.tree.map(lambda a: a.delete(), given)
    assert given._repr_png_() is None


def test_jupyter_finds_the_pictures():
    formatters = pytest.importorskip("IPython.core.formatters")
    scene, camera = scene_of("random")
    ask = formatters.DisplayFormatter().format
    data, size = ask(picture(random_picture()))
    assert pixels_of(data["image/png"]).shape == (12, 16, 3)
    assert size["image/png"]["width"] == 240
    assert "image/png" in ask(scene)[0]
    assert "text/html" in ask(camera)[0]
    assert "text/html" in ask(movie([random_picture()]))[0]


# --- movies ---


@pytest.mark.parametrize("kind", ["webp", "gif", "webm"])
def test_a_movie_decodes_to_its_frames(kind, tmp_path):
    frames = np.stack([random_picture(24, 32, seed) for seed in range(5)])
    made = movie(frames, fps=10, kind=kind)
    found = re.search(rf'src="data:(\w+)/{kind};base64,([^"]+)"', made._repr_html_())
    data = base64.b64decode(found[2])
    assert found[1] == ("video" if kind == "webm" else "image")
    assert data == made.data
    assert made.frames == 5
    assert made.size == (224, 168)
    if kind == "webm":
        (tmp_path / "a.webm").write_bytes(data)
        capture, count = cv2.VideoCapture(str(tmp_path / "a.webm")), 0
        while capture.read()[0]:
            count += 1
    else:
        _, animation = cv2.imdecodeanimation(np.frombuffer(data, np.uint8))
        count = len(animation.frames)
    assert count == 5


def test_wrong_movies():
    with pytest.raises(gsjax.InputError, match="no movie of kind 'avi'"):
        movie([random_picture()], kind="avi")
    with pytest.raises(gsjax.InputError, match="no frames"):
        movie([])
    with pytest.raises(gsjax.InputError, match="one size"):
        movie([random_picture(8, 8), random_picture(8, 9)])


# --- display, with a stand-in for Jupyter's ---


@pytest.fixture
def displayed(monkeypatch):
    """Pictures as they were shown, and as they replaced one another."""
    shown, replaced = [], []

    def display(value, **options):
        shown.append((value, options))
        return SimpleNamespace(update=replaced.append)

    monkeypatch.setattr(notebook, "_display", display)
    return shown, replaced


def test_show_displays_a_picture(displayed):
    image = random_picture()
    assert show(image) is None
    ((found, _),) = displayed[0]
    np.testing.assert_array_equal(found.pixels, to_8_bit(image))


def test_live_draws_in_one_place(displayed, monkeypatch):
    image = random_picture(24, 32)
    calls = []

    def render_exact(gaussians, camera, config, background):
        assert background.shape == (3,)
        calls.append((gaussians, camera, config))
        return render_of(rgb=jnp.asarray(image), depth=jnp.ones((24, 32)))

    def comparison(rows, **options):
        (row,) = rows
        told.append((row.name, row.rendered))
        return contact_sheets.comparison(rows, **options)

    told = []
    monkeypatch.setattr(notebook, "render_exact", render_exact)
    monkeypatch.setattr(notebook, "comparison", comparison)
    first, replaced = displayed
    for photo in (None, to_8_bit(image)):
        first.clear(), replaced.clear(), calls.clear()
        hook = live("camera", photo, every=3)
        for step in range(1, 8):
            metrics = SimpleNamespace(step=step, psnr=20.0 + step, gaussians=7)
            scene = SimpleNamespace(name=f"scene {step}", capacity=99)
            hook(SimpleNamespace(gaussians=scene), SimpleNamespace(metrics=metrics))
        assert [s.name for s, _, _ in calls] == ["scene 1", "scene 3", "scene 6"]
        assert {config.visible_capacity for _, _, config in calls} == {99}
        assert {camera for _, camera, _ in calls} == {"camera"}
        assert {config.outputs for _, _, config in calls} == {("rgb", "depth")}
        assert len(first) == 1
        assert first[0][1] == {"display_id": True}
        assert len(replaced) == 2
        assert all(isinstance(one, Picture) for one in replaced)
        assert not np.array_equal(replaced[0].pixels, replaced[1].pixels)
    # The step is that of the render.
    assert told == [("photograph", f"step {step},") for step in (1, 3, 6)]
    with pytest.raises(gsjax.InputError, match="every is 0"):
        live("camera", every=0)


# --- the notebooks themselves; CI executes them ---


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_both_halves_of_a_notebook_agree(path):
    jupytext = pytest.importorskip("jupytext")
    written = [(c.cell_type, c.source) for c in jupytext.read(path).cells]
    kept = json.loads(path.with_suffix(".ipynb").read_text(encoding="utf-8"))["cells"]
    assert [(c["cell_type"], "".join(c["source"])) for c in kept] == written
    outputs = [out for cell in kept for out in cell.get("outputs", ())]
    assert any("image/png" in out.get("data", ()) for out in outputs)
    assert all(out["output_type"] != "error" for out in outputs)


def test_the_notebooks_are_small():
    assert len(NOTEBOOKS) >= 6
    assert sum(p.with_suffix(".ipynb").stat().st_size for p in NOTEBOOKS) < 6e6
