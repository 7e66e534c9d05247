"""Fine-tuning: what is drawn in training is what the files hold afterwards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import RASTER, camera_at, dataset, photos, true_gaussians

import gsjax
from gsjax.compression.finetune import Finetuning, finetune, quantised_model
from gsjax.compression.importance import measure_importance
from gsjax.compression.quantise import (
    as_gaussians,
    make_source,
    quantise,
    rows_of,
)
from gsjax.compression.search import write_and_read
from gsjax.train.config import TrainConfig
from gsjax.train.models import SceneParams

pytestmark = pytest.mark.usefixtures("float32")
NUMBERS = "means", "quats", "log_scales", "logit_opacities", "sh"


@pytest.fixture(scope="module")
def quantised(float32):
    """A scene of degree 1 in two files, coarse enough that numbers are rounded."""
    del float32
    rng = np.random.default_rng(0)
    rows = rows_of(true_gaussians())
    rest = rng.normal(0, 0.2, (6, 3, 3))[np.arange(len(rows["means"])) % 6]
    rows["sh"] = np.concatenate([rows["sh"], rest], 1).astype(np.float32)
    cameras = [camera_at(view) for view in dataset().views]
    importance = measure_importance(as_gaussians(rows), cameras, RASTER)
    scene = quantise(make_source(rows, importance, ".sog", 2), 2e-7)
    assert 30 < len(scene.kept) <= 60
    assert set(scene.part) == {0, 1}
    assert scene.coding.palette.used > 1
    assert scene.coding.steps["means"].max() > 16
    return scene


def assert_equal_rows(found, expected) -> None:
    """Compare Gaussians in any order."""
    both = []
    for rows in (rows_of(found), rows_of(expected)):
        order = np.lexsort(rows["means"].round(4).T)
        both.append({name: rows[name][order] for name in NUMBERS})
    for name in NUMBERS:
        np.testing.assert_allclose(both[0][name], both[1][name], atol=2e-5)


def test_the_model_draws_rounded_numbers(quantised):
    coding = quantised.coding
    model = quantised_model(quantised, coding.lattice, coding.palette)
    rows = quantised.rows | {"sh": quantised.rows["sh"][:, :1]}
    start = gsjax.grow(as_gaussians(rows), 64)
    extra = model.init(start)

    def draw(params):
        return model.scene(SceneParams(start.replace(params=params), extra))

    assert_equal_rows(draw(start.params), as_gaussians(quantised.rows))
    means = start.params.means
    fixed = np.asarray(extra.buffers["fixed"])[: len(rows["means"])]
    assert 2 < fixed.sum() <= 12  # in two boxes of six sides

    def first(means):
        drawn = draw(start.params.replace(means=means)).params.means
        return jnp.sum(drawn[: len(fixed)])

    slopes = np.asarray(jax.grad(first)(means))[: len(fixed)]
    np.testing.assert_array_equal(slopes, np.repeat(~fixed[:, None], 3, 1))
    # Steps of a half and more: a small move changes nothing.
    moved = draw(start.params.replace(means=means + 2e-6)).params.means
    change = np.abs(np.asarray(moved - draw(start.params).params.means))
    assert np.mean(change[: len(fixed)] < 5e-7) > 0.9


def test_training_lowers_the_error_and_files_hold_the_result(quantised):
    config = TrainConfig(steps=1000, sh_degree=1, ssim_weight=0.0, raster=RASTER)
    found = finetune(quantised, Finetuning(dataset(), photos(), config, 60))

    def error(scene) -> float:
        drawn = [
            gsjax.render(as_gaussians(scene.rows), camera_at(view), RASTER).rgb
            for view in dataset().views
        ]
        truth = [photo.pixels / 255 for photo in photos()]
        return float(np.mean((np.stack(drawn) - np.stack(truth)) ** 2))

    assert error(found) < 0.7 * error(quantised)
    assert not np.array_equal(found.rows["means"], quantised.rows["means"])
    for file in found.files():
        _, read = write_and_read(file, ".sog", None)
        assert_equal_rows(read, file)
