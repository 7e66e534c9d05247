"""Training and evaluation through lenses and rolling shutters."""

from dataclasses import replace
from functools import cache

import numpy as np
from training import EXTENT, HEIGHT, RASTER, VIEWS, WIDTH, dataset, true_gaussians

import gsjax
from gsjax.cameras.camera import with_shutter
from gsjax.densify.mcmc import McmcSettings
from gsjax.runs.refined_cameras import refine_dataset, refine_photos
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import evaluate
from gsjax.train.loop import fit

OPENCV = (-0.25, 0.05, 0.0, 0.0)
TWIST = np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0])
SHUTTER = "top_to_bottom"
CONFIG = TrainConfig(
    steps=60,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=1000, opacity_penalty=0.0, scale_penalty=0.0),
    shutter=SHUTTER,
    refine_intrinsics=True,
    refine_shutter=True,
    intrinsics_rate=2e-3,
    shutter_rate=4e-3,
    raster=RASTER.replace(alpha_min=1e-4),
)


@cache
def seen_through_a_lens():
    """Return the dataset and its photographs through a lens, while cameras turn."""
    cameras, images = [], []
    for view in dataset().views:
        still = gsjax.make_camera(
            viewmat=view.viewmat,
            K=view.K,
            width=WIDTH,
            height=HEIGHT,
            lens="opencv",
            coefficients=OPENCV,
        )
        camera = with_shutter(still, SHUTTER, twist=TWIST)
        cameras.append(camera)
        image = gsjax.render_exact(true_gaussians(), camera, CONFIG.raster).rgb
        images.append(np.clip(np.asarray(image), 0, 1))
    found, photos = gsjax.make_dataset(images, cameras, dataset().points)
    views = tuple(replace(view, twist=TWIST) for view in found.views)
    return replace(found, views=views), photos


def psnr(found, photos, shutter=SHUTTER):
    views = evaluate(
        true_gaussians(), found.views, photos, config=CONFIG.raster, shutter=shutter
    )
    return np.mean([view.psnr for view in views])


def test_evaluation_renders_through_lens_and_shutter():
    found, photos = seen_through_a_lens()
    right = psnr(found, photos)
    assert right > 45  # the rounding of photographs to 8 bits
    assert psnr(found, photos, "global") < right - 5
    ignored = psnr(found, [photo._replace(lens=None) for photo in photos])
    assert ignored < right - 5


def test_lens_and_shutter_are_recovered():
    """Part of the way, from a pinhole that stands still, in 60 steps."""
    found, photos = seen_through_a_lens()
    views = tuple(replace(view, lens=None, twist=None) for view in found.views)
    given = replace(found, views=views)
    blind = [photo._replace(lens=None) for photo in photos]
    state = gsjax.init_state(true_gaussians(), CONFIG, EXTENT, VIEWS)
    result = fit(given, blind, CONFIG, state=state)
    refinement = result.state.refinement
    refined = refine_dataset(given, list(range(VIEWS)), refinement, EXTENT, CONFIG)
    assert refined.views[0].lens.coefficients[0] < -0.05
    turns = [view.twist[1] for view in refined.views]
    assert min(turns) > 0.02, turns
    after = refine_photos(blind, given.views, refined.views)
    assert psnr(refined, after) > psnr(given, blind) + 3
