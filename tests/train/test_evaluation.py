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


def test_scores_compare_the_render_with_the_photograph(gaussians, scene, renders):
    """Over the background, if it is transparent; only valid pixels count."""
    mixed, inner = np.zeros((24, 32), np.uint8), np.zeros((24, 32), bool)
    mixed[:, ::2], mixed[:, 1::4], inner[4:20, 3:28] = 255, 51, True
    spoilt = np.where(inner[..., None], renders[0], 255 - renders[0])
    for pixels, alpha, valid in (
        (renders[0], None, None),
        (renders[0], mixed, None),
        (spoilt, None, inner),
        (spoilt, None, None),
        (renders[0], None, np.zeros((24, 32), bool)),
    ):
        photo = photo_of(scene.views[0], pixels, alpha, valid)
        (result,) = scored(gaussians, scene, [photo])
        share = 1 if alpha is None else alpha[..., None] / 255
        truth = np.float32(pixels / 255 * share + np.asarray(BEHIND) * (1 - share))
        np.testing.assert_allclose(result.truth, truth, atol=1e-6)
        np.testing.assert_allclose(result.render * 255, renders[0], atol=0.51)
        np.testing.assert_equal(result.valid, valid)
        if valid is not None and not valid.any():
            assert np.isnan([result.psnr, result.ssim]).all()
            continue
        given = result.render, truth, None if valid is None else np.float32(valid)
        np.testing.assert_allclose(result.psnr, psnr(*given), rtol=1e-4)
        np.testing.assert_allclose(result.ssim, ssim(*given), rtol=1e-5)
        if pixels is renders[0] and alpha is None:  # only rounded
            assert result.psnr > 10 * np.log10(12 * 255**2) - 1.5
            assert result.ssim > 0.999


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
    view, part_of = scene.views[0], f"{scene.views[0].name}: {part} of the photo"
    good = photo_of(view, np.zeros((24, 32, 3), np.uint8))
    photo = good._replace(**{part: value})
    with pytest.raises(InputError, match=part_of):
        scored(gaussians, scene, [photo])
    with pytest.raises(InputError, match=part_of):
        check_photos(replace(scene, views=scene.views[:1]), [photo])
    with pytest.raises(ValueError, match="shorter"):
        list(evaluate(gaussians, scene.views, [good], config=CONFIG))


def test_summary_is_the_mean_of_the_views():
    """Those that are fully masked do not count."""
    none = np.zeros((1, 1, 3))
    masked, *results = (
        ViewResult(str(i), p, s, none, none, none[..., 0], None)
        for i, (p, s) in enumerate([(np.nan,) * 2, (20, 0.5), (30, 0.9), (25, 0.7)])
    )
    found = summarise(iter([*results, masked]))
    assert found == (3, 25.0, pytest.approx(0.7), LPIPS_NOTE)
    for nothing in (summarise([]), summarise([masked])):
        assert nothing.views == 0
        assert np.isnan([nothing.psnr, nothing.ssim]).all()
