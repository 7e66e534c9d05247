"""Compressed scenes, measured anew: what is stated is what the file holds."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from captures import rejects
from conftest import camera_of, frustum_points, gaussians_at
from training import dataset

import gsjax
from gsjax import RasterConfig
from gsjax.cli.main import main
from gsjax.compression.finetune import Finetuning
from gsjax.compression.quantise import rows_of
from gsjax.compression.types import CompressedScene, Goal, HeldOut
from gsjax.data.transforms import CameraEntry, transforms_json
from gsjax.train.config import mip_raster, preset

pytestmark = [
    pytest.mark.usefixtures("float32"),
    pytest.mark.filterwarnings("ignore:.*Gaussians have"),
]
CONFIG, FAST = RasterConfig(tile_size=8), preset("fast")
BACKGROUND = (0.1, 0.2, 0.3)


def make_scene(count: int = 300) -> gsjax.Gaussians:
    """Overlapping, with harmonics that few Gaussians need, and inactive slots."""
    rng = np.random.default_rng(0)
    points = frustum_points(rng, count, far=6.0, spread=0.5)
    scales = np.exp(rng.normal(-2.2, 0.4, (count, 3)))
    gaussians = gaussians_at(points, scales, rng.uniform(0.1, 0.95, count))
    sh = rng.normal(0, 0.03, (count, 4, 3))
    sh[:, 0] = rng.normal(0, 0.8, (count, 3))
    sh[::7, 1:] *= 4
    params = gaussians.params.replace(sh=jnp.asarray(sh, jnp.float32))
    return gaussians.replace(params=params, active=jnp.arange(count) % 10 != 3)


@pytest.fixture(scope="module")
def scene(float32) -> gsjax.Gaussians:
    del float32
    return make_scene()


@pytest.fixture(scope="module")
def cameras(float32) -> list[gsjax.Camera]:
    del float32
    shift = np.eye(4)
    found = []
    for x in np.linspace(-0.3, 0.3, 4):
        shift = shift.copy()
        shift[0, 3] = x
        camera = camera_of(40, 30)
        found.append(camera.replace(viewmat=jnp.asarray(shift @ camera.viewmat)))
    return found


def pictures(gaussians, cameras) -> np.ndarray:
    behind = jnp.asarray(BACKGROUND, jnp.float32)
    drawn = [gsjax.render_exact(gaussians, c, CONFIG, behind).rgb for c in cameras]
    return np.clip(np.stack(drawn), 0, 1)


def psnr(found, expected) -> float:
    return float(-10 * np.log10(np.mean((found - expected) ** 2, (1, 2, 3))).mean())


def compressed(scene, cameras, goal, **kwargs) -> CompressedScene:
    return gsjax.compress(
        scene, cameras, goal=goal, config=CONFIG, background=BACKGROUND, **kwargs
    )


def read_back(result: CompressedScene, folder: Path) -> gsjax.Gaussians:
    path = folder / f"a{result.suffix}"
    result.save(path)
    assert (path.read_bytes(),) == result.files
    return gsjax.load(path)


@pytest.mark.parametrize("suffix", [".sog", ".spz"])
def test_the_loss_against_photographs_is_that_of_the_file(
    scene, cameras, tmp_path, suffix
):
    rng = np.random.default_rng(1)
    before = pictures(scene, cameras)
    photos = np.clip(before + rng.normal(0, 0.02, before.shape), 0, 1)
    held_out = HeldOut(cameras, [*photos.astype(np.float32)])
    goal = Goal(max_loss=0.5)
    result = compressed(scene, cameras, goal, suffix=suffix, held_out=held_out)
    found = pictures(read_back(result, tmp_path), cameras)
    loss = psnr(before, photos) - psnr(found, photos)
    assert result.loss == pytest.approx(loss, abs=1e-3)
    assert 0.1 < loss <= 0.5
    assert result.after.psnr_before == pytest.approx(psnr(found, before), abs=0.01)
    largest = np.abs(found - before).max()
    assert result.after.largest_error == pytest.approx(largest, abs=1e-5)
    gsjax.save(tmp_path / "all.ply", scene)
    assert result.size_before == (tmp_path / "all.ply").stat().st_size
    assert result.size < result.size_before / 4
    assert any(f"{result.loss:.3f} dB lost" in line for line in result.lines())


def test_sizes_and_errors_are_met(scene, cameras, tmp_path):
    small = compressed(scene, cameras, Goal(max_size=4000))
    assert 2000 < small.size <= 4000
    parts = compressed(scene, cameras, Goal(max_size=11_000, parts=3))
    assert 6000 < parts.size <= 11_000
    paths = parts.save(tmp_path / "scene.sog")
    assert [path.name for path in paths] == [f"scene-{k}.sog" for k in (1, 2, 3)]
    read = [gsjax.load(path) for path in paths]
    counts = [int(gsjax.num_active(one)) for one in read]
    assert sum(counts) == int(gsjax.num_active(parts.gaussians))
    np.testing.assert_allclose(np.cumsum(counts) / sum(counts), [0.1, 0.32, 1], 0.03)
    whole = pictures(parts.gaussians, cameras)
    union = gsjax.concatenate(gsjax.concatenate(read[0], read[1]), read[2])
    np.testing.assert_allclose(pictures(union, cameras), whole, atol=1e-5)
    # The first tenth shows more than the tenth after it.
    errors = [np.mean((pictures(one, cameras) - whole) ** 2) for one in read[:2]]
    assert errors[0] < errors[1]
    assert [r.what for r in parts.reasons if "part" in r.what] == [
        f"part {k}" for k in (1, 2, 3)
    ]
    fine = compressed(scene, cameras, Goal(max_error=8 / 255))
    found = pictures(read_back(fine, tmp_path), cameras)
    assert np.abs(found - pictures(scene, cameras)).max() <= 8.01 / 255
    assert fine.after.psnr_before > small.after.psnr_before
    # Without photographs: 10 log10 of the error of 30 dB and this one together.
    error = 10 ** (-fine.after.psnr_before / 10)
    assert fine.loss == pytest.approx(10 * np.log10(1 + error / 1e-3))


def test_files_without_entropy_coding_lose_gaussians_only(scene, cameras, tmp_path):
    result = compressed(scene, cameras, Goal(max_loss=0.5), suffix=".ply")
    found, whole = rows_of(read_back(result, tmp_path)), rows_of(scene)
    assert len(found["means"]) < len(whole["means"])
    place = {tuple(mean): slot for slot, mean in enumerate(whole["means"])}
    slots = [place[tuple(mean)] for mean in found["means"]]
    # What is kept has all its numbers, but for bands of harmonics that are dropped.
    for name in ("quats", "log_scales", "logit_opacities"):
        np.testing.assert_allclose(found[name], whole[name][slots], rtol=1e-6)
    kept = found["sh"].shape[1]
    np.testing.assert_array_equal(found["sh"][:, 1:], whole["sh"][slots, 1:kept])


def test_the_command(scene, cameras, tmp_path, capsys):
    """A file with cameras; the loss that is printed follows from the file."""
    source, out = tmp_path / "a.ply", tmp_path / "new" / "scene.spz"
    gsjax.save(source, scene)
    entries = [CameraEntry(f"c{k}", camera) for k, camera in enumerate(cameras * 2)]
    (tmp_path / "cameras.json").write_text(transforms_json(entries))
    words = ["compress", source, "--cameras", tmp_path / "cameras.json", "-o", out]
    assert main([*map(str, words), "--max-loss", "0.5dB"]) == 0
    text = capsys.readouterr().out
    loss = float(re.search(r"smaller, ([0-9.]+) dB lost, an estimate", text)[1])
    config = RasterConfig.compat()
    both = [
        np.clip(gsjax.render_exact(one, cameras[0], config).rgb, 0, 1)[None]
        for one in (gsjax.load(out), scene)
    ]
    error = 10 ** (-psnr(*both) / 10)
    assert loss == pytest.approx(10 * np.log10(1 + error / 1e-3), abs=2e-3)
    assert 0 < loss <= 0.5
    assert f"{out}  {out.stat().st_size / 1e6:.2f} MB" in text
    assert main([*map(str, words)]) == 3
    assert "exists; pass --overwrite" in capsys.readouterr().err
    assert main([*map(str, words), "--overwrite", "--finetune", "5"]) == 3
    assert "expected a run for fine-tuning" in capsys.readouterr().err
    for wrong, message in (
        (["--max-loss", "x"], "such as 0.3dB"),
        (["--max-size", "0MB"], "such as 5MB"),
        (["--budget", "2"], "such as 2/255"),
        (["--budget", "1/255", "--max-size", "5MB"], "pass one of"),
    ):
        assert main([*map(str, words), "--overwrite", *wrong]) == 2
        assert message in capsys.readouterr().err


def test_a_render_mode_that_is_lost_is_reported(scene, cameras):
    empty = gsjax.select(scene, np.zeros(scene.capacity, bool))
    mip = mip_raster(CONFIG)
    with pytest.warns(UserWarning, match="do not record the render mode 'mip'"):
        rejects(
            "at least one", gsjax.compress, empty, cameras, suffix=".glb", config=mip
        )


def test_refusals(scene, cameras):
    empty = gsjax.select(scene, np.zeros(scene.capacity, bool))
    rows = [
        ((scene, []), {}, "at least one camera"),
        ((empty, cameras), {}, "at least one that can be drawn"),
        ((scene, cameras), {"suffix": ".splat"}, "suffix: expected one of"),
        ((scene, cameras), {"goal": Goal()}, "expected one goal, got none"),
        ((scene, cameras), {"goal": Goal(0.1, 9)}, "got max_loss, max_size"),
        ((scene, cameras), {"goal": Goal(max_loss=-1.0)}, "expected a positive"),
        ((scene, cameras), {"held_out": HeldOut([])}, "held_out: expected at least"),
        ((scene, cameras), {"goal": Goal(0.1, parts=0)}, "parts: expected at least 1"),
        (
            (scene, cameras),
            {
                "goal": Goal(max_error=0.1),
                "finetuning": Finetuning(dataset(), [], FAST),
            },
            "finetuning: expected another goal",
        ),
        ((scene, cameras), {"goal": Goal(max_size=10)}, "got .* at the least"),
    ]
    for args, kwargs, message in rows:
        rejects(message, gsjax.compress, *args, **{"config": CONFIG} | kwargs)
