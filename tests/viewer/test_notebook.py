"""Pictures in notebooks and files: exact pixels; nothing is drawn under tracing."""

import base64
import json
import re
from pathlib import Path
from unittest.mock import ANY, Mock

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, scene_of

import gsjax
from gsjax.io.images import to_8_bit
from gsjax.raster.types import Demand, Render
from gsjax.viewer import notebook
from gsjax.viewer.notebook import live, movie, picture, show

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
    """The images that a render might return."""
    fields = dict.fromkeys(Render._fields) | images
    demand = Demand(*(jnp.int32(1),) * len(Demand._fields))
    fields |= {"radii": jnp.zeros((*batch, 3)), "demand": demand}
    return Render(**fields | {"overflowed": jnp.bool(overflowed)})


def test_one_picture_keeps_its_pixels(tmp_path):
    """Those that are not finite are magenta."""
    image = random_picture()
    eight = to_8_bit(image)
    spoilt = image.copy()
    spoilt[3, 4, 1] = np.nan
    wanted = eight.copy()
    wanted[3, 4] = MAGENTA
    np.testing.assert_array_equal(shown(picture(spoilt)), wanted)
    for value in (image, eight, picture(image), render_of(rgb=jnp.asarray(image))):
        np.testing.assert_array_equal(shown(picture(value)), eight)
    grey = shown(picture(image[..., 0]))
    np.testing.assert_array_equal(grey, np.repeat(eight[..., :1], 3, axis=2))
    path = tmp_path / "a.png"
    for _ in range(2):  # it may exist
        gsjax.save_png(path, render_of(rgb=image))
    np.testing.assert_array_equal(pixels_of(path.read_bytes()), eight)
    picture(image, zoom=2).save(str(path))
    np.testing.assert_array_equal(pixels_of(path.read_bytes())[::2, ::2], eight)
    png, size = picture(image)._repr_png_()
    assert size == {"width": 240, "height": 180}, "displayed enlarged"
    assert pixels_of(png).shape == (12, 16, 3)


@pytest.mark.parametrize("columns", [1, 2, None])
def test_a_grid_holds_every_picture(columns):
    batch = np.stack([random_picture(seed=seed) for seed in range(3)])
    for found in (
        picture(batch, columns=columns).pixels,
        picture(list(batch), captions=["a", "b", "c"], columns=columns).pixels,
        shown(render_of((3,), rgb=batch)),
    ):
        assert found.shape[1] <= 1200
        for image in to_8_bit(batch):
            windows = np.lib.stride_tricks.sliding_window_view(found, (12, 16, 3))
            assert (windows[:, :, 0] == image).all(axis=(2, 3, 4)).sum() == 1
    assert picture(np.zeros((30, 40, 500, 3)), columns=30).pixels.shape[1] <= 1200


def test_refused_pictures(tmp_path):
    image = random_picture()
    for call, message in (
        (lambda: picture(np.zeros((1, 2, 3, 4, 5))), r"\(1, 2, 3, 4, 5\)"),
        (lambda: picture("a.png"), "expected arrays, .*got str"),
        (lambda: picture(image, captions=["a", "b"]), "captions: expected 1, .*got 2"),
        (lambda: picture(image, zoom=0), "zoom: expected .*got 0"),
        (lambda: picture(), "at least one picture"),
        (lambda: picture(image).save(tmp_path / "a.jpg"), r"suffix \.png, got '\.jpg'"),
        (lambda: movie([image], kind="avi"), "kind: expected one of .*got 'avi'"),
        (lambda: movie([]), "at least one frame"),
        (lambda: movie([image, random_picture(8, 9)]), "frame 1: expected the shape"),
        (lambda: live("camera", every=0), "every: expected at least 1"),
    ):
        with pytest.raises(gsjax.InputError, match=message):
            call()


def test_renders_and_gaussians_are_displayed():
    """All images of a render, and a sketch of the colours of Gaussians."""
    image = random_picture()
    alone = shown(render_of(rgb=image))
    full = shown(render_of(rgb=image, alpha=image[..., 0], depth=1 + image[..., 0]))
    assert full.size >= 3 * alone.size
    for channels in (1, 2, 5):
        features = np.full((6, 7, channels), 0.5)
        assert shown(render_of(rgb=features))[0, 0, 0] == 128
    scene, _ = scene_of("random")
    found = shown(scene)
    assert len(np.unique(found.reshape(-1, 3), axis=0)) > 50
    assert len(scene._repr_png_()[0]) < 200_000
    empty = shown(gsjax.select(scene, jnp.zeros(scene.capacity, bool)))
    assert not np.array_equal(empty, found)
    bad = jax.tree.map(lambda a: a.at[::3].set(jnp.nan), scene.params)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), scene)
    for other in (scene.replace(params=bad), batch):
        assert shown(other).size > 0


def test_a_camera_describes_its_pose():
    camera = camera_of(viewmat=gsjax.look_at((1.0, -5.0, 2.0), (1.0, 0.0, 2.0)))
    text = camera._repr_html_()
    assert "at (1, -5, 2); looking along (0.00, 1.00, 0.00)" in text
    assert "3 cameras" in gsjax.stack_cameras([camera] * 3)._repr_html_()


def test_nothing_is_drawn_without_values():
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
    seen.append(jax.eval_shape(lambda s: s, scene)._repr_png_())
    seen.append(jax.tree.map(lambda _: None, scene)._repr_png_())
    seen.append(jax.tree.map(lambda _: "x", camera)._repr_html_())
    donated = jax.tree.map(jnp.copy, scene)
    jax.tree.map(lambda a: a.delete(), donated)
    seen.append(donated._repr_png_())
    assert not any(seen)


@pytest.mark.parametrize("kind", ["webp", "gif", "webm", "mp4"])
def test_a_movie_is_embedded(kind, tmp_path):
    if kind == "mp4":
        pytest.importorskip("av", reason="needs gsjax[movies]")
    frames = np.stack([random_picture(24, 32, seed) for seed in range(5)])
    made = movie(frames, fps=10, kind=kind)
    found = re.search(rf'src="data:(\w+)/{kind};base64,([^"]+)"', made._repr_html_())
    video = kind in ("webm", "mp4")
    assert found[1] == ("video" if video else "image")
    assert ("<video" in made._repr_html_()) == video
    assert base64.b64decode(found[2]) == made.data
    assert (made.frames, made.size) == (5, (224, 168))
    path = tmp_path / f"a.{kind}"
    path.write_bytes(made.data)
    again = tmp_path / f"b.{kind}"
    assert gsjax.save_movie(again, iter(frames), fps=10) == 5
    assert len(again.read_bytes()) == len(made.data)  # a .webm has a random number
    capture = cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)
    assert (capture if video else cv2.imcount(str(path))) == 5


def test_live_updates_one_display(monkeypatch):
    image = random_picture(24, 32)
    view = render_of(rgb=jnp.asarray(image), depth=jnp.ones((24, 32)))
    for photo in (None, to_8_bit(image)):
        display, render_exact = Mock(), Mock(return_value=view)
        monkeypatch.setattr(notebook, "_display", display)
        monkeypatch.setattr(notebook, "render_exact", render_exact)
        hook = live("camera", photo, every=3, background=[0, 0, 1])
        for step in range(1, 8):
            metrics = Mock(step=step, psnr=20.0 + step, gaussians=7)
            hook(
                Mock(**{"params.gaussians.capacity": 100 + step}), Mock(metrics=metrics)
            )
        drawn = [call.args for call in render_exact.call_args_list]
        assert [scene.capacity for scene, *_ in drawn] == [101, 103, 106]
        for scene, _, config, background in drawn:
            assert config.visible_capacity == scene.capacity
            assert config.outputs == ("rgb", "depth")
            assert background.tolist() == [0, 0, 1]
        display.assert_called_once_with(ANY, display_id=True)
        updates = display.return_value.update.call_args_list
        first, second = (call.args[0].pixels for call in updates)
        assert not np.array_equal(first, second)
    assert show(image) is None
    np.testing.assert_array_equal(display.call_args.args[0].pixels, to_8_bit(image))


def test_both_files_of_a_notebook_agree():
    """Their pictures were displayed without errors and are small."""
    jupytext = pytest.importorskip("jupytext")
    assert len(NOTEBOOKS) >= 6
    sizes = [path.with_suffix(".ipynb").stat().st_size for path in NOTEBOOKS]
    assert sum(sizes) < 6e6
    for path in NOTEBOOKS:
        written = [(c.cell_type, c.source) for c in jupytext.read(path).cells]
        kept = json.loads(path.with_suffix(".ipynb").read_bytes())["cells"]
        assert [(c["cell_type"], "".join(c["source"])) for c in kept] == written
        outputs = [out for cell in kept for out in cell.get("outputs", ())]
        assert any("image/png" in out.get("data", ()) for out in outputs)
        assert all(out["output_type"] != "error" for out in outputs)
