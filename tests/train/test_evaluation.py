"""Laws of the evaluation of held-out views."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from captures import dataset_of_views
from conftest import LIGHT, assert_not_empty

import gsjax
from gsjax import InputError, RasterConfig
from gsjax.data.types import Photo
from gsjax.init.gaussians import init_gaussians
from gsjax.train.evaluation import LPIPS_NOTE, ViewResult, evaluate, summarise
from gsjax.train.health import check_photos
from gsjax.train.metrics import psnr, ssim

CONFIG = RasterConfig(**LIGHT)
BEHIND = (0.2, 0.6, 0.4)


@pytest.fixture(scope="module")
def scene():
    return dataset_of_views(count=2, points=60)


@pytest.fixture(scope="module")
def gaussians(scene):
    return init_gaussians(scene, sh_degree=0, opacity=0.8, scale=2.0)


def photo_of(view, pixels, alpha=None, valid=None):
    return Photo(pixels, alpha, valid, view.K)


def scored(gaussians, scene, photos, **kwargs):
    views = scene.views[: len(photos)]
    kwargs = {"config": CONFIG, "background": BEHIND, **kwargs}
    return list(evaluate(gaussians, views, photos, **kwargs))


@pytest.fixture(scope="module")
def renders(gaussians, scene):
    blank = [photo_of(v, np.zeros((24, 32, 3), np.uint8)) for v in scene.views]
    results = scored(gaussians, scene, blank)
    for view, result in zip(scene.views, results):
        camera = gsjax.make_camera(viewmat=view.viewmat, K=view.K, width=32, height=24)
        out = gsjax.render_exact(gaussians, camera, CONFIG, jnp.asarray(BEHIND))
        assert_not_empty(out.alpha)
        np.testing.assert_allclose(
            result.render, np.clip(out.rgb, 0, 1), atol=2e-6, err_msg=view.name
        )
        np.testing.assert_allclose(result.depth, out.depth, rtol=1e-5)
        assert result.name == view.name
        assert result.render.dtype == result.depth.dtype == np.float32
    return [np.rint(r.render * 255).astype(np.uint8) for r in results]


def test_a_photograph_of_the_scene_scores_its_rounding(gaussians, scene, renders):
    photos = [photo_of(v, r) for v, r in zip(scene.views, renders)]
    results = scored(gaussians, scene, photos)
    for result in results:
        assert result.psnr > 10 * np.log10(12 * 255**2) - 1.5
        assert result.ssim > 0.999
        np.testing.assert_allclose(result.psnr, psnr(result.render, result.truth), 1e-4)
        np.testing.assert_allclose(result.ssim, ssim(result.render, result.truth), 1e-5)
        assert result.valid is None
    shifted = [p._replace(pixels=np.minimum(p.pixels, 229) + 26) for p in photos]
    known = -20 * np.log10(26 / 255)
    for result, pixels in zip(scored(gaussians, scene, shifted), renders):
        if pixels.max() <= 229:
            assert result.psnr == pytest.approx(known, abs=0.1)
    assert min(p.max() for p in renders) <= 229


def test_only_valid_pixels_count(gaussians, scene, renders):
    valid = np.zeros((24, 32), bool)
    valid[4:20, 3:28] = True
    spoilt = np.where(valid[..., None], renders[0], 255 - renders[0])
    (whole,) = scored(gaussians, scene, [photo_of(scene.views[0], spoilt)])
    photo = photo_of(scene.views[0], spoilt, valid=valid)
    (result,) = scored(gaussians, scene, [photo])
    clean = photo_of(scene.views[0], renders[0], valid=valid)
    (wanted,) = scored(gaussians, scene, [clean])
    assert (result.psnr, result.ssim) == (wanted.psnr, wanted.ssim)
    assert result.psnr > 50 > 20 > whole.psnr
    np.testing.assert_array_equal(result.valid, valid)


def test_fully_masked_views_are_left_out(gaussians, scene, renders):
    masked = photo_of(scene.views[0], renders[0], valid=np.zeros((24, 32), bool))
    photos = [masked, photo_of(scene.views[1], renders[1])]
    first, second = scored(gaussians, scene, photos)
    assert np.isnan([first.psnr, first.ssim]).all()
    np.testing.assert_allclose(first.render * 255, renders[0], atol=0.51)
    assert summarise([first, second])[:3] == (1, second.psnr, second.ssim)
    assert summarise([first]).views == 0


def test_transparent_photographs_are_over_the_background(gaussians, scene, renders):
    alpha = np.zeros((24, 32), np.uint8)
    alpha[:, ::2], alpha[:, 1::4] = 255, 51
    photo = photo_of(scene.views[0], renders[0], alpha)
    (result,) = scored(gaussians, scene, [photo])
    share = alpha[..., None] / 255
    wanted = renders[0] / 255 * share + np.asarray(BEHIND) * (1 - share)
    np.testing.assert_allclose(result.truth, wanted, atol=1e-6)


def test_photographs_of_unequal_sizes_score_as_alone(gaussians, scene, renders):
    rng = np.random.default_rng(0)
    sizes = [(24, 20), (15, 32)]
    seen = rng.uniform(size=sizes[1]) > 0.3
    photos = [
        Photo(r[:h, :w], None, valid, v.K)
        for r, (h, w), valid, v in zip(renders, sizes, (None, seen), scene.views)
    ]
    together = scored(gaussians, scene, photos)
    for index, found in enumerate(together):
        part = replace(scene, views=scene.views[index : index + 1])
        alone = scored(gaussians, part, photos[index : index + 1])[0]
        assert found.render.shape == (*sizes[index], 3)
        assert found.psnr == pytest.approx(alone.psnr, rel=1e-4)
        assert found.ssim == pytest.approx(alone.ssim, rel=1e-4)
        for name in ("render", "truth", "depth"):
            wanted = getattr(alone, name)
            np.testing.assert_allclose(getattr(found, name), wanted, atol=2e-6)
        assert alone.psnr > 40


def test_missing_photographs_are_rejected(gaussians, scene, renders):
    photo = photo_of(scene.views[0], renders[0])
    with pytest.raises(ValueError, match="shorter"):
        list(evaluate(gaussians, scene.views, [photo], config=CONFIG))


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("pixels", np.zeros((24, 32, 3), np.float32)),
        ("pixels", np.zeros((24, 32, 4), np.uint8)),
        ("pixels", np.zeros((24, 32), np.uint8)),
        ("pixels", np.zeros((0, 32, 3), np.uint8)),
        ("alpha", np.zeros((24, 31), np.uint8)),
        ("alpha", np.zeros((24, 32))),
        ("valid", np.zeros((24, 32), np.uint8)),
        ("K", np.eye(4)),
        ("K", None),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_malformed_photographs_are_rejected(part, value, gaussians, scene):
    view = scene.views[0]
    photo = photo_of(view, np.zeros((24, 32, 3), np.uint8))._replace(**{part: value})
    with pytest.raises(InputError, match=f"{view.name}: {part} of the photo"):
        scored(gaussians, scene, [photo])
    with pytest.raises(InputError, match=f"{view.name}: {part} of the photo"):
        check_photos(replace(scene, views=scene.views[:1]), [photo])


def test_summary_is_the_mean_of_the_views():
    none = np.zeros((1, 1, 3))
    results = [
        ViewResult(str(i), p, s, none, none, none[..., 0], None)
        for i, (p, s) in enumerate([(20.0, 0.5), (30.0, 0.9), (25.0, 0.7)])
    ]
    assert summarise(iter(results)) == (3, 25.0, pytest.approx(0.7), LPIPS_NOTE)
    nothing = summarise([])
    assert nothing.views == 0
    assert np.isnan([nothing.psnr, nothing.ssim]).all()
